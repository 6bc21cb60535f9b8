// Injected light -> initial state of a volume, and the total so far. A second set of sums may be added.
#include "common/light_cells.glsl"

layout(local_size_x = 64) in;
layout(std430) readonly buffer First { int first[]; };
layout(std430) readonly buffer Second { int second[]; };
layout(std430) readonly buffer Third { int third[]; };
layout(rgba32f) writeonly uniform image3D state;
layout(rgba32f) writeonly uniform image3D total;
uniform int cells;
uniform int count_of_sums;

void main() {
    uint count = uint(cells * cells * cells), i = gl_GlobalInvocationID.x;
    if (i >= count) return;
    ivec3 cell = cell_of_index(i, cells);
    for (int channel = 0; channel < 3; ++channel) {
        vec4 light;
        for (uint k = 0u; k < 4u; ++k) {
            uint at = i * uint(INJECTED_SUMS) + 4u * uint(channel) + k;
            int sum = first[at];
            if (count_of_sums > 1) sum += second[at];
            if (count_of_sums > 2) sum += third[at];
            light[k] = float(sum) / INJECTED_STEPS;
        }
        imageStore(state, in_channel(cell, channel, cells), light);
        imageStore(total, in_channel(cell, channel, cells), light);
    }
}
