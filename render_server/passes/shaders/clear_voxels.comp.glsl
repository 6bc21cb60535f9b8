// Empties the voxels that a set touched: its grid cells, and their texels in all directions of a mipmap.
#include "common/volume.glsl"
#include "common/walk.glsl"
#define GRID_ACCESS
#define TOUCHED_ACCESS readonly
#include "common/voxel_store.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image3D mipmap;
uniform bool free_slots;    // also release the slots

void main() {
    for (uint i = first_item(); i < slot_count; i += items_apart()) {
        ivec3 v = enter_volume_of(touched[i], volume_size);
        for (int k = 0; k < DIRECTIONS; ++k) imageStore(mipmap, level_base(0, k) + v, vec4(0.0));
        if (free_slots) grid[touched[i]] = 0u;
    }
}
