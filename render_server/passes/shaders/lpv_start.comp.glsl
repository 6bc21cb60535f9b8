// Injected light -> initial state of a volume, and the total so far. ADD: adds it to light that is under way.
#include "common/light_cells.glsl"
#include "common/injected_light.glsl"

layout(local_size_x = 64) in;
#ifdef ADD
layout(rgba32f) uniform image3D state;
layout(rgba32f) uniform image3D total;

void add(ivec3 texel, vec4 light) {
    imageStore(state, texel, imageLoad(state, texel) + light);
    imageStore(total, texel, imageLoad(total, texel) + light);
}
#else
layout(rgba32f) writeonly uniform image3D state;
layout(rgba32f) writeonly uniform image3D total;

void add(ivec3 texel, vec4 light) {
    imageStore(state, texel, light);
    imageStore(total, texel, light);
}
#endif
uniform int cells;

void main() {
    int i = int(gl_GlobalInvocationID.x);
    if (i >= cells * cells * cells) return;
    ivec3 cell = cell_of_index(uint(i), cells);
    for (int channel = 0; channel < 3; ++channel) add(in_channel(cell, channel, cells), injected_light(i, channel));
}
