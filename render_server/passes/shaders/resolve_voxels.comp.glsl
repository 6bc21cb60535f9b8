// Fixed-point sums -> premultiplied (c_k, a_k) texels of level 0, only where a set touched a voxel. Without RHO it walks
// the real set: (c_mu, a_real). With RHO it adds the change of its light and the virtual set, then walks that for the
// voxels without real geometry. Marks in the mipmap's occupancy, on all levels, what it walks: with RHO the latter alone, for it
// begins with mu's. With SPENDS_DELTA, the sums of the change are left empty.
#include "common/volume.glsl"
#include "common/walk.glsl"
#define TOUCHED_ACCESS readonly
#define SUMS_ACCESS readonly
#ifdef RHO
#define GRID_ACCESS readonly
#endif
#include "common/voxel_store.glsl"
#define OCCUPANCY_ACCESS
#include "common/occupancy.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image3D mipmap;
uniform bool marks;   // the occupancy; or that is done
#ifdef RHO
#ifdef SPENDS_DELTA
layout(std430) buffer DeltaSums { int delta_sums[]; };
#else
layout(std430) readonly buffer DeltaSums { int delta_sums[]; };
#endif
layout(std430) readonly buffer VirtualGrid { uint virtual_grid[]; };
layout(std430) readonly buffer VirtualTouched { uint virtual_count; uint virtual_touched[]; };
layout(std430) readonly buffer VirtualSums { int virtual_sums[]; };
#endif

// A voxel face cannot be covered more than once: further layers occlude each other, radiance keeps its mean.
vec4 at_most_covered(vec4 c) { return c.a > 1.0 ? c / c.a : c; }

#ifdef RHO
ivec3 take_delta(int at) {
    ivec3 delta = ivec3(delta_sums[at], delta_sums[at + 1], delta_sums[at + 2]);
#ifdef SPENDS_DELTA
    delta_sums[at] = delta_sums[at + 1] = delta_sums[at + 2] = 0;
#endif
    return delta;
}
#endif

vec4 real_texel(int slot, int k) {
    int at = slot * SUMS_PER_SLOT;
    ivec3 c = ivec3(sums[at + RADIANCE + k * 3], sums[at + RADIANCE + k * 3 + 1], sums[at + RADIANCE + k * 3 + 2]);
#ifdef RHO
    c += take_delta(slot * 18 + k * 3);
#endif
    return at_most_covered(vec4(vec3(c), float(sums[at + COVERAGE + k])) / FIXED_POINT);
}

#ifdef RHO
vec4 virtual_texel(int slot, int k) {
    int at = slot * SUMS_PER_SLOT;
    vec3 c = vec3(virtual_sums[at + RADIANCE + k * 3], virtual_sums[at + RADIANCE + k * 3 + 1],
        virtual_sums[at + RADIANCE + k * 3 + 2]);
    return at_most_covered(vec4(c, float(virtual_sums[at + COVERAGE + k])) / FIXED_POINT);
}
#endif

void mark(int level, ivec3 corner, uint bits) {
    int word = volume * mipmap_words(volume_size) + corner_word(volume_size, level, corner);
    if ((occupied[word] & bits) != bits) atomicOr(occupied[word], bits);
}

void occupy(ivec3 cell, int level) {
    int bit = cell.x & 31;
    for (int j = 0; j < 4; ++j) {
        ivec3 corner = cell + ivec3(0, j & 1, j >> 1);
        mark(level, corner, bit < 31 ? 3u << bit : 1u << 31);
        if (bit == 31) mark(level, corner + ivec3(1, 0, 0), 1u);
    }
}

void occupy(ivec3 voxel) {
    for (int level = 0; level < volume_levels; ++level) occupy(voxel >> level, level);
}

void main() {
    for (uint i = first_item(); i < slot_count; i += items_apart()) {
        uint voxel = touched[i];
        ivec3 v = enter_volume_of(voxel, volume_size);
        for (int k = 0; k < 6; ++k) {
            vec4 c = real_texel(int(i), k);
#ifdef RHO
            uint other = virtual_grid[voxel];
            if (other != 0u) c = at_most_covered(c + virtual_texel(int(other - 1u), k));
#endif
            imageStore(mipmap, level_base(0, k) + v, c);
        }
#ifndef RHO
        if (marks) occupy(v);
#endif
    }
#ifdef RHO
    for (uint i = first_item(); i < virtual_count; i += items_apart()) {
        uint voxel = virtual_touched[i];
        if (grid[voxel] != 0u) continue;
        ivec3 v = enter_volume_of(voxel, volume_size);
        for (int k = 0; k < 6; ++k) imageStore(mipmap, level_base(0, k) + v, virtual_texel(int(i), k));
        if (marks) occupy(v);
    }
#endif
}
