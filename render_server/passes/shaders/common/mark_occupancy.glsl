// Marks in a mipmap's occupancy, on all levels, the cells of a voxel. Needs volume.glsl.
#define OCCUPANCY_ACCESS
#include "common/occupancy.glsl"

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
