// The objects' injected change, for view `volume`: a cell that gains light in its colour, one that loses light in
// red, as radiance; opacity 0 where nothing was injected.
#include "common/light_cells.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
layout(rgba16f) writeonly uniform image3D shown;
layout(std430) readonly buffer Change { int change[]; };
layout(std430) readonly buffer Shadow { int shadow[]; };
uniform int cells;

const float RADIANCE = 1.0 / LOBE.x;   // of the first coefficient: flux / (pi edge^2)

void main() {
    ivec3 cell = ivec3(gl_GlobalInvocationID);
    if (!in_grid(cell, cells)) return;
    uint at = cell_index(cell, cells) * uint(INJECTED_SUMS);
    vec3 light;
    for (uint channel = 0u; channel < 3u; ++channel)
        light[channel] = RADIANCE * float(change[at + 4u * channel] + shadow[at + 4u * channel]) / INJECTED_STEPS;
    float mean = dot(light, vec3(1.0 / 3.0));
    imageStore(shown, cell, vec4(mean < 0.0 ? vec3(-mean, 0.0, 0.0) : max(light, vec3(0.0)), light == vec3(0.0) ? 0.0 : 1.0));
}
