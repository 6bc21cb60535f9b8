// The objects' injected change, for view `volume`: a cell that gains light in its colour, one that loses light in
// red, as radiance; opacity 0 where nothing was injected.
#include "common/light_cells.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
layout(rgba16f) writeonly uniform image3D shown;
layout(std430) readonly buffer Change { int change[]; };
layout(std430) readonly buffer Direct { int direct[]; };
uniform int cells;
uniform int direct_cells;   // of the same cube; 0: none
uniform int first;          // x of the volume's first cell among all volumes

const float RADIANCE = 1.0 / LOBE.x;   // of the first coefficient: flux / (pi edge^2)

vec3 radiance_of(ivec3 cell) {
    uint at = cell_index(cell, cells) * uint(INJECTED_SUMS);
    return RADIANCE * vec3(change[at], change[at + 4u], change[at + 8u]) / INJECTED_STEPS;
}

vec3 direct_radiance(ivec3 cell) {
    uint at = cell_index(cell, direct_cells) * uint(INJECTED_SUMS);
    return RADIANCE * vec3(direct[at], direct[at + 4u], direct[at + 8u]) / INJECTED_STEPS;
}

// Mean over the cells of the direct change that lie in this one, or the one that holds it.
vec3 direct_mean(ivec3 cell) {
    ivec3 low = cell * direct_cells / cells, high = max((cell + 1) * direct_cells / cells, low + 1);
    vec3 sum = vec3(0.0);
    for (int z = low.z; z < high.z; ++z)
        for (int y = low.y; y < high.y; ++y)
            for (int x = low.x; x < high.x; ++x) sum += direct_radiance(ivec3(x, y, z));
    ivec3 count = high - low;
    return sum / float(count.x * count.y * count.z);
}

void main() {
    ivec3 cell = ivec3(gl_GlobalInvocationID);
    if (!in_grid(cell, cells)) return;
    vec3 light = radiance_of(cell);
    if (direct_cells > 0) light += direct_mean(cell);
    float mean = dot(light, vec3(1.0 / 3.0));
    imageStore(shown, cell + ivec3(first, 0, 0), vec4(mean < 0.0 ? vec3(-mean, 0.0, 0.0) : max(light, vec3(0.0)), light == vec3(0.0) ? 0.0 : 1.0));
}
