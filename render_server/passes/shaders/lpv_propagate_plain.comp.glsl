// One step of propagation as in lpv_propagate.comp.glsl, directly from memory, which is fastest in software.
#include "common/light_cells.glsl"
#include "common/light_step.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
layout(std430) readonly buffer State { vec4 state[]; };
layout(std430) writeonly buffer Next { vec4 next_state[]; };
layout(std430) buffer Total { vec4 total[]; };

vec4 light_of(uint place) { return state[place]; }
#include "common/light_neighbours.glsl"

void main() {
    ivec3 cell = ivec3(gl_GlobalInvocationID);
    if (!in_grid(cell, cells)) return;
    Neighbours n = neighbours_of(cell);
    uint here = cell_index(cell, cells), count = uint(cells * cells * cells);
    for (uint base = 0u; base < 3u * count; base += count) {
        vec4 sum = entering(n, base);
        next_state[base + here] = sum;
        total[base + here] += sum;
    }
}
