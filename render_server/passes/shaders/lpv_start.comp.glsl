// Injected light -> initial state of a volume, and the total so far. A second set of sums may be added.
#include "common/light_cells.glsl"

layout(local_size_x = 64) in;
layout(std430) readonly buffer First { int first[]; };
layout(std430) readonly buffer Second { int second[]; };
layout(std430) readonly buffer Third { int third[]; };
layout(std430) writeonly buffer State { vec4 state[]; };   // channel by channel
layout(std430) writeonly buffer Total { vec4 total[]; };
uniform int cells;
uniform int count_of_sums;

void main() {
    uint count = uint(cells * cells * cells), i = gl_GlobalInvocationID.x;
    if (i >= count) return;
    for (uint channel = 0u; channel < 3u; ++channel) {
        vec4 light;
        for (uint k = 0u; k < 4u; ++k) {
            uint at = i * uint(INJECTED_SUMS) + 4u * channel + k;
            int sum = first[at];
            if (count_of_sums > 1) sum += second[at];
            if (count_of_sums > 2) sum += third[at];
            light[k] = float(sum) / INJECTED_STEPS;
        }
        state[channel * count + i] = light;
        total[channel * count + i] = light;
    }
}
