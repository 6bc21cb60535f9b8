// Geometry volume: how much of each cell face surfaces cover (after Kaplanyan & Dachsbacher 2010). A face stands for the
// cube of a cell's edge about its centre, so that a surface blocks between the cell in which its light starts and the one
// behind it. Surfels were clipped to half cells, so each lies in one such cube an axis. Kept are the areas across each
// axis rather than spherical harmonics of them: only these are ever asked for. The two sides are summed apart, so that
// both sides of a thin body do not count as two bodies.
#define SURFELS_ACCESS readonly
#include "common/voxel_store.glsl"
#include "common/walk.glsl"
#include "common/light_cells.glsl"
#ifndef CUTOUTS
#pragma switch CUTOUTS
#else
#define MATERIAL_MAPS
#include "common/materials.glsl"
#endif

layout(local_size_x = 64) in;
layout(std430) buffer Covered { int covered[]; };   // 6 per cell: its low faces on x, y, z; by surfaces that face -, +
uniform int cells;
uniform float cell_edge;   // m

void cover(Surfel s, vec3 n) {
    float area = s.position_area.w;
#ifdef CUTOUTS
    area *= opacity_of(int(s.normal_material.w), s.uv_voxel.xy, s.tint.w, sqrt(area));
#endif
    ivec3 half_cell = voxel_of_index(floatBitsToUint(s.uv_voxel.z), 2 * cells);
    for (int axis = 0; axis < 3; ++axis) {
        ivec3 cell = half_cell >> 1;
        cell[axis] = (half_cell[axis] + 1) >> 1;
        float fraction = abs(n[axis]) * area / (cell_edge * cell_edge);
        if (fraction == 0.0 || !in_grid(cell, cells)) continue;
        uint at = cell_index(cell, cells) * 6u + uint(2 * axis + (n[axis] < 0.0 ? 0 : 1));
        atomicAdd(covered[at], fixed_point(fraction));
    }
}

void main() {
    uint count = surfels_held();
    for (uint i = first_item(); i < count; i += items_apart()) {
        Surfel s = surfels[i];
        cover(s, s.normal_material.xyz);
        if (s.uv_voxel.w > 0.5) cover(s, -s.normal_material.xyz);
    }
}
