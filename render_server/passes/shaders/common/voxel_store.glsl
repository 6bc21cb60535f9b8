// Sparse voxel store of one geometry set (real or virtual): a grid of slots, the list of touched voxels, one surfel
// for every piece of a triangle inside a voxel, and fixed-point sums per slot. Integer atomics keep it bit-identical.
struct Surfel {
    vec4 position_area;    // world m, m^2
    vec4 normal_material;  // unit normal, material index
    vec4 uv_voxel;         // texture or picture coordinate, voxel index (bits), double-sided flag
    vec4 tint;             // vertex colour
};

layout(std430) buffer Grid { uint grid[]; };          // slot + 1 of each voxel, 0 = untouched
layout(std430) buffer Touched { uint touched[]; };    // voxel index of each slot
layout(std430) buffer Surfels { Surfel surfels[]; };
layout(std430) buffer Counters { uint slot_count; uint surfel_count; uint surfel_capacity; uint spare; };
layout(std430) buffer Sums { int sums[]; };           // SUMS_PER_SLOT per slot

const int COVERAGE = 0;          // 6 directions
const int RADIANCE = 6;          // 6 directions x rgb
const int SUMS_PER_SLOT = 24;
const float FIXED_POINT = 1048576.0;   // 2^20 steps: 1e-6 resolution, sums up to 2047 (voxel faces, camera units)

int fixed_point(float x) { return int(round(x * FIXED_POINT)); }

uint voxel_index(ivec3 v, int n) { return uint((v.z * n + v.y) * n + v.x); }

ivec3 voxel_of_index(uint i, int n) { return ivec3(int(i) % n, (int(i) / n) % n, int(i) / (n * n)); }
