// Marks the touched voxels of a set in a mipmap's occupancy, on all levels.
#include "common/volume.glsl"
#include "common/walk.glsl"
#define TOUCHED_ACCESS readonly
#include "common/voxel_store.glsl"
#define OCCUPANCY_ACCESS
#include "common/occupancy.glsl"

layout(local_size_x = 64) in;

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

void main() {
    for (uint i = first_item(); i < slot_count; i += items_apart()) {
        ivec3 v = enter_volume_of(touched[i], volume_size);
        for (int level = 0; level < volume_levels; ++level) occupy(v >> level, level);
    }
}
