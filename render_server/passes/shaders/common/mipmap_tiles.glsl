// All levels of a mipmap's slabs (one for each direction of each volume) in one dispatch. A workgroup filters a tile of the first
// level, then the cells above it, which need no others; the last workgroup of a slab to end filters the levels above those, of the
// slab alone. The shader has write_cell(level, cell, k), and coherent images.
layout(local_size_x = 8, local_size_y = 8, local_size_z = 8) in;
#include "common/last_group.glsl"
uniform int first_level;   // to write; >= 1
uniform int level_count;   // how many are written
const int TILE = 8, TILE_LEVELS = 4, THREADS = TILE * TILE * TILE;

int thread() { return int(gl_LocalInvocationIndex); }

// Lets the whole workgroup see what each of its invocations stored.
void synchronize_stores() {
    memoryBarrierImage();
    barrier();
}

void filter_tile(ivec3 tile, int k) {
    for (int done = 0; done < min(level_count, TILE_LEVELS); ++done) {
        int edge = TILE >> done, level = first_level + done, i = thread();
        ivec3 own = ivec3(i % edge, i / edge % edge, i / (edge * edge)), cell = tile * edge + own;
        if (own.z < edge && all(lessThan(cell, ivec3(volume_size >> level)))) write_cell(level, cell, k);
        synchronize_stores();
    }
}

void filter_above_tiles(int k) {
    for (int level = first_level + TILE_LEVELS; level < first_level + level_count; ++level) {
        int n = volume_size >> level;
        for (int i = thread(); i < n * n * n; i += THREADS) write_cell(level, ivec3(i % n, i / n % n, i / (n * n)), k);
        synchronize_stores();
    }
}

void main() {
    int tiles = ((volume_size >> first_level) + TILE - 1) / TILE, z = int(gl_WorkGroupID.z), slab = z / tiles;
    int k = slab % DIRECTIONS;
    work_in_volume(slab / DIRECTIONS);
    filter_tile(ivec3(gl_WorkGroupID.xy, z % tiles), k);
    if (level_count > TILE_LEVELS && ends_part(slab, uint(tiles * tiles * tiles))) filter_above_tiles(k);
}
