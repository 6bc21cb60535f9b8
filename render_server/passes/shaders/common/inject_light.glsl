// Adds a surface's reflected flux to the cell half a cell in front of it ([P2] 4.3.1). Needs volume.glsl.
#include "common/light_cells.glsl"

layout(std430) buffer Injected { int injected[]; };

// I(w) = flux / pi <axis, w>+ of a point at q (cells).
void inject_at(vec3 q, vec3 axis, vec3 flux) {
    if (!inside_volume(q)) return;
    int at = int(cell_index(ivec3(q), volume_size)) * INJECTED_SUMS;
    vec4 shape = lobe(axis) / PI * (INJECTED_STEPS / (voxel_edge * voxel_edge));
    for (int channel = 0; channel < 3; ++channel)
        for (int i = 0; i < 4; ++i) atomicAdd(injected[at + 4 * channel + i], int(round(flux[channel] * shape[i])));
}

// The same of a point at p (world, m), shifted half a cell along `axis`.
void inject(vec3 p, vec3 axis, vec3 flux) { inject_at(volume_coordinate(p) + 0.5 * axis, axis, flux); }
