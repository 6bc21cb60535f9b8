// Fixed-point sums -> premultiplied (c_k, a_k) texels of level 0, only where a set touched a voxel. Without RHO it walks
// the real set: (c_mu, a_real). With RHO it adds the change of its light and the virtual set, then walks that for the
// voxels without real geometry. Marks in the mipmap's occupancy, on all levels, what it walks: with RHO the latter alone, for it
// begins with mu's.
#include "common/volume.glsl"
#include "common/walk.glsl"
#define TOUCHED_ACCESS readonly
#define SUMS_ACCESS readonly
#ifdef RHO
#define GRID_ACCESS readonly
#endif
#include "common/voxel_store.glsl"
#include "common/resolved_voxels.glsl"
#include "common/mark_occupancy.glsl"
#include "common/rolled.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image3D mipmap;
uniform bool marks;   // the occupancy; or that is done
#ifdef RHO
layout(std430) readonly buffer VirtualTouched { uint virtual_count; uint virtual_touched[]; };
#endif

void main() {
    for (uint i = first_item(); i < slot_count; i += items_apart()) {
        uint voxel = touched[i];
        ivec3 v = enter_volume_of(voxel, volume_size);
        for (int k = 0; k < rolled(6); ++k) {
#ifdef RHO
            vec4 c = joint_texel(int(i), virtual_grid[voxel], k);
#else
            vec4 c = real_texel(int(i), k);
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
        for (int k = 0; k < rolled(6); ++k) imageStore(mipmap, level_base(0, k) + v, virtual_texel(int(i), k));
        if (marks) occupy(v);
    }
#endif
}
