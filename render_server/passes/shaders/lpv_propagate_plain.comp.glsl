// One step of propagation as in lpv_propagate.comp.glsl, directly from memory, which is fastest in software.
#include "common/light_cells.glsl"
#include "common/light_step.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
layout(std430) readonly buffer State { vec4 state[]; };
layout(std430) writeonly buffer Next { vec4 next_state[]; };
layout(std430) buffer Total { vec4 total[]; };
layout(std430) readonly buffer Transmitted { uvec2 transmitted[]; };
uniform int cells;
uniform bool has_geometry;

void main() {
    ivec3 cell = ivec3(gl_GlobalInvocationID);
    if (!in_grid(cell, cells)) return;
    uint here = cell_index(cell, cells), count = uint(cells * cells * cells);
    uvec2 open = has_geometry ? transmitted[here] : uvec2(0xffffffffu);
    ivec3 last = ivec3(cells - 1);
    vec4 xy = unpackUnorm4x8(open.x) * vec4(cell.x > 0, cell.x < last.x, cell.y > 0, cell.y < last.y);
    vec2 z = unpackUnorm4x8(open.y).xy * vec2(cell.z > 0, cell.z < last.z);
    uint row = uint(cells), layer = row * row;
    uint left = here - (cell.x > 0 ? 1u : 0u), right = here + (cell.x < last.x ? 1u : 0u);
    uint front = here - (cell.y > 0 ? row : 0u), back = here + (cell.y < last.y ? row : 0u);
    uint below = here - (cell.z > 0 ? layer : 0u), above = here + (cell.z < last.z ? layer : 0u);
    for (uint channel = 0u; channel < 3u; ++channel) {
        uint base = channel * count;
        vec4 sum = xy.x * along_x(state[base + left], 1.0);
        sum += xy.y * along_x(state[base + right], -1.0);
        sum += xy.z * along_y(state[base + front], 1.0);
        sum += xy.w * along_y(state[base + back], -1.0);
        sum += z.x * along_z(state[base + below], 1.0);
        sum += z.y * along_z(state[base + above], -1.0);
        next_state[base + here] = sum;
        total[base + here] += sum;
    }
}
