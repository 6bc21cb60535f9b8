// Sparse voxel store of one geometry set (real or virtual): a grid of slots, the list of touched voxels, one surfel
// for every piece of a triangle inside a voxel, and fixed-point sums a slot. Integer atomics keep it bit-identical.
// OpenGL guarantees no more than eight storage blocks, so a shader declares those that it uses: before this file it
// defines GRID_ACCESS, TOUCHED_ACCESS, SURFELS_ACCESS or SUMS_ACCESS, as `readonly`, or empty to write the block too.
#include "common/quotient.glsl"
struct Surfel {
    vec4 position_area;    // world m, m^2
    vec4 normal_material;  // unit normal, material index
    vec4 uv_voxel;         // texture or picture coordinate, voxel index (bits), double-sided flag
    vec4 tint;             // vertex colour, opacity of the vertices
};

#ifdef GRID_ACCESS
layout(std430) GRID_ACCESS buffer Grid { uint grid[]; };   // slot + 1 of each voxel, 0 = untouched
#endif
#ifdef TOUCHED_ACCESS
layout(std430) TOUCHED_ACCESS buffer Touched { uint slot_count; uint touched[]; };   // voxel index of each slot
#endif
#ifdef SURFELS_ACCESS
layout(std430) SURFELS_ACCESS buffer Surfels { uint surfel_count; Surfel surfels[]; };

uint surfels_held() { return min(surfel_count, uint(surfels.length())); }
#endif
#ifdef SUMS_ACCESS
layout(std430) SUMS_ACCESS buffer Sums { int sums[]; };    // SUMS_PER_SLOT a slot
#endif

const int COVERAGE = 0;          // 6 directions
const int RADIANCE = 6;          // 6 directions x rgb
const int SUMS_PER_SLOT = 24;
const float FIXED_POINT = 1048576.0;   // 2^20 steps: 1e-6 resolution, sums up to 2047 (voxel faces, camera units)

int fixed_point(float x) { return int(round(x * FIXED_POINT)); }

// Voxels of further volumes follow in z.
uint voxel_index(ivec3 v, int n) { return uint((v.z * n + v.y) * n + v.x); }

ivec3 voxel_of_index(uint i, int n) {
    int row = quotient(int(i), n), layer = quotient(row, n);
    return ivec3(int(i) - row * n, row - layer * n, layer);
}

#ifdef SEVERAL_VOLUMES
// Goes to the volume of a voxel, or of a block of the coarser grid of `n` an edge, and returns its place there.
ivec3 enter_volume_of(uint i, int n) {
    ivec3 v = voxel_of_index(i, n);
    volume = v.z / n;
    return v - ivec3(0, 0, volume * n);
}
#else
ivec3 enter_volume_of(uint i, int n) { return voxel_of_index(i, n); }
#endif
