// One step of propagation as in lpv_propagate.comp.glsl, directly from memory, which is fastest in software.
#include "common/light_cells.glsl"
#include "common/light_step.glsl"

layout(local_size_x = 16) in;
layout(rgba32f) readonly uniform image3D state;
layout(rgba32f) writeonly uniform image3D next_state;
layout(rgba32f) uniform image3D total;

vec4 light_of(ivec3 texel) { return imageLoad(state, texel); }
#include "common/light_neighbours.glsl"

void main() {
    ivec3 cell = ivec3(gl_GlobalInvocationID);
    if (!in_grid(cell, cells)) return;
    Neighbours n = neighbours_of(cell);
    for (int channel = 0; channel < 3; ++channel) {
        ivec3 texel = in_channel(cell, channel, cells);
        vec4 sum = entering(cell, n, channel);
        imageStore(next_state, texel, sum);
        imageStore(total, texel, imageLoad(total, texel) + sum);
    }
}
