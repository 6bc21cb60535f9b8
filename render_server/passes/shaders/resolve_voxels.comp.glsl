// Fixed-point sums -> premultiplied (c_k, a_k) texels of level 0, only where the walked set touched a voxel. MU walks
// the real set: (c_mu, a_real). RHO_REAL walks it too and adds the change of its light and the virtual set;
// RHO_VIRTUAL walks the virtual set and writes the voxels without real geometry.
#include "common/volume.glsl"
#include "common/walk.glsl"
#define TOUCHED_ACCESS readonly
#define SUMS_ACCESS readonly
#include "common/voxel_store.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image3D mipmap;
#ifdef RHO_REAL
layout(std430) readonly buffer DeltaSums { int delta_sums[]; };
layout(std430) readonly buffer OtherSums { int other_sums[]; };
#endif
#if defined(RHO_REAL) || defined(RHO_VIRTUAL)
layout(std430) readonly buffer OtherGrid { uint other_grid[]; };
#endif

// A voxel face cannot be covered more than once: further layers occlude each other, radiance keeps its mean.
vec4 at_most_covered(vec4 c) { return c.a > 1.0 ? c / c.a : c; }

vec4 own_texel(int slot, int k) {
    int at = slot * SUMS_PER_SLOT;
    ivec3 c = ivec3(sums[at + RADIANCE + k * 3], sums[at + RADIANCE + k * 3 + 1], sums[at + RADIANCE + k * 3 + 2]);
#ifdef RHO_REAL
    c += ivec3(delta_sums[slot * 18 + k * 3], delta_sums[slot * 18 + k * 3 + 1], delta_sums[slot * 18 + k * 3 + 2]);
#endif
    return at_most_covered(vec4(vec3(c), float(sums[at + COVERAGE + k])) / FIXED_POINT);
}

#ifdef RHO_REAL
vec4 virtual_texel(int slot, int k) {
    int at = slot * SUMS_PER_SLOT;
    vec3 c = vec3(other_sums[at + RADIANCE + k * 3], other_sums[at + RADIANCE + k * 3 + 1],
        other_sums[at + RADIANCE + k * 3 + 2]);
    return at_most_covered(vec4(c, float(other_sums[at + COVERAGE + k])) / FIXED_POINT);
}
#endif

void main() {
    for (uint i = first_item(); i < slot_count; i += items_apart()) {
        uint voxel = touched[i];
#ifdef RHO_VIRTUAL
        if (other_grid[voxel] != 0u) continue;
#endif
        ivec3 v = enter_volume_of(voxel, volume_size);
        for (int k = 0; k < 6; ++k) {
            vec4 c = own_texel(int(i), k);
#ifdef RHO_REAL
            uint other = other_grid[voxel];
            if (other != 0u) c = at_most_covered(c + virtual_texel(int(other - 1u), k));
#endif
            imageStore(mipmap, level_base(0, k) + v, c);
        }
    }
}
