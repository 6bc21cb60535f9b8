// Empties the voxels that a set touched: its grid cells, and their texels in all directions of a mipmap or of two; with
// LEVEL_1 also those above them, which filter_voxels does not visit again where it walks lists. With BUFFERS, all of two
// buffers that follow from the voxels: a mipmap's occupancy and the grid of groups.
#include "common/volume.glsl"
#include "common/walk.glsl"
#define GRID_ACCESS
#define TOUCHED_ACCESS readonly
#include "common/voxel_store.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image3D mipmap;
#ifdef TWO
layout(rgba16f) writeonly uniform image3D second;
#endif

#ifdef BUFFERS
layout(std430) writeonly buffer Occupied { uint occupied[]; };
layout(std430) writeonly buffer GroupGrid { uint group_grid[]; };
#endif

void empty(ivec3 texel) {
    imageStore(mipmap, texel, vec4(0.0));
#ifdef TWO
    imageStore(second, texel, vec4(0.0));
#endif
}

void main() {
    for (uint i = first_item(); i < slot_count; i += items_apart()) {
        ivec3 v = enter_volume_of(touched[i], volume_size);
        for (int k = 0; k < DIRECTIONS; ++k) {
            empty(level_base(0, k) + v);
#ifdef LEVEL_1
            empty(level_base(1, k) + v / 2);
#endif
        }
        grid[touched[i]] = 0u;
    }
#ifdef BUFFERS
    for (uint i = first_item(); i < uint(occupied.length()); i += items_apart()) occupied[i] = 0u;
    for (uint i = first_item(); i < uint(group_grid.length()); i += items_apart()) group_grid[i] = 0u;
#endif
}
