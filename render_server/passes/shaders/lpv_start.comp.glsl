// Injected light -> initial state of a volume, and the total so far.
// HALF_STEP: after the first half step (lpv_half_step.comp.glsl), of the cells of colour 0.
#include "common/light_cells.glsl"
#include "common/injected_light.glsl"
#pragma switch HALF_STEP

layout(local_size_x = 64) in;
layout(rgba32f) writeonly uniform image3D state;
layout(rgba32f) writeonly uniform image3D total;
#ifdef HALF_STEP
#include "common/light_step.glsl"
vec4 light_of(ivec3 texel);
#include "common/light_neighbours.glsl"

vec4 light_of(ivec3 texel) {
    int channel = texel.z / cells;
    return injected_light(int(cell_index(texel - ivec3(0, 0, channel * cells), cells)), channel);
}

// What enters with it.
vec4 entered(ivec3 cell, int channel) {
    return ((cell.x + cell.y + cell.z) & 1) == 0 ? entering(cell, neighbours_of(cell), channel) : vec4(0.0);
}
#else
uniform int cells;
vec4 entered(ivec3 cell, int channel) { return vec4(0.0); }
#endif

void main() {
    int i = int(gl_GlobalInvocationID.x);
    if (i >= cells * cells * cells) return;
    ivec3 cell = cell_of_index(uint(i), cells);
    for (int channel = 0; channel < 3; ++channel) {
        ivec3 texel = in_channel(cell, channel, cells);
        vec4 light = injected_light(i, channel);
        imageStore(state, texel, light);
        imageStore(total, texel, light + entered(cell, channel));
    }
}
