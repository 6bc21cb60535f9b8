// Which cells of a mipmap's levels hold anything: a bit for each corner between cells, set if any of the eight around it
// is touched, so that one bit tells of all cells that a trilinear sample reads.
#ifdef OCCUPANCY_ACCESS
layout(std430) buffer Occupied { uint occupied[]; };
#else
layout(std430) readonly buffer Occupied { uint occupied[]; };
#endif

// Words of a row and of a level with that many cells an edge; level 1 and all above take as many as level 1.
int row_words(int cells) { return cells / 32 + 1; }

int level_words(int cells) { return (cells + 1) * (cells + 1) * row_words(cells); }

// Word that holds the bit of a corner.
int corner_word(int n, int level, ivec3 corner) {
    int cells = n >> level;
    int first = level == 0 ? 0 : level_words(n) + (level - 1) * level_words(n >> 1);
    return first + (corner.z * (cells + 1) + corner.y) * row_words(cells) + (corner.x >> 5);
}

// Words of a whole mipmap: those of volumes follow one another.
int mipmap_words(int n) { return level_words(n) + (findMSB(n) + 1) * level_words(n >> 1); }

// Whether any of the cells around a corner is touched, in a volume of n voxels an edge that follows `number` others.
bool is_occupied(int number, int n, int level, ivec3 corner) {
    int word = number * mipmap_words(n) + corner_word(n, level, corner);
    return (occupied[word] >> (corner.x & 31) & 1u) != 0u;
}

// The corner around which a trilinear sample at q (voxels of level 0) reads.
ivec3 corner_of(vec3 q, int level) { return ivec3(floor(q * exp2(-float(level)) + 0.5)); }
