// Injected light in fixed point -> intensity. Needs light_cells.glsl.
layout(std430) readonly buffer First { int first[]; };
layout(std430) readonly buffer Second { int second[]; };
uniform bool has_second;   // sums, which are added

vec4 injected_light(int cell, int channel) {
    vec4 light;
    for (int k = 0; k < 4; ++k) {
        int at = cell * INJECTED_SUMS + 4 * channel + k, sum = first[at];
        if (has_second) sum += second[at];
        light[k] = float(sum) / INJECTED_STEPS;
    }
    return light;
}
