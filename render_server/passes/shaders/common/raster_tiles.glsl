// Square tiles of a raster row by row, what is marked in them, and lists of the triangles that may show there. Tiles of level 0 have
// 2^TILE_BITS texels an edge, those of each further level MOST_TILES times as many. Texels' centres are at integers.
const int TILE_BITS = 1;     // TILE = 2; shifts, because llvmpipe divides integers lane by lane
const int LEVEL_BITS = 4;
const int MOST_TILES = 1 << LEVEL_BITS;   // along an axis: a triangle is in the lists of the first level where it spans no more
const int LEVELS = 4;
const uint UNEVEN = 1u;   // the samples of a pixel there may differ
const uint THIN = 2u;     // something there may be thinner than a texel
const uint FULL = 0xffffffffu;   // ends a list for which there was no room
const float REACH = 0.45;   // texels from a pixel's place to its furthest sample along an axis: less than half of one
struct Tile { uint marks; uint first; };   // first: node of the list + 1, 0: none
uniform ivec2 raster_size;
uniform ivec4 level_starts;   // number of each level's first tile

int tile_bits(int level) { return TILE_BITS + LEVEL_BITS * level; }   // of its edge

ivec2 tile_of(vec2 place, int level) {
    return clamp(ivec2(floor(place + 0.5)), ivec2(0), raster_size - 1) >> tile_bits(level);
}

int tile_number(ivec2 tile, int level) {
    int bits = tile_bits(level);
    return level_starts[level] + tile.y * ((raster_size.x + (1 << bits) - 1) >> bits) + tile.x;
}

// The tiles around a place that hold the samples of a pixel there.
int tile_around(vec2 place, int corner, int level) {
    return tile_number(tile_of(place + REACH * (2.0 * vec2(corner & 1, corner >> 1) - 1.0), level), level);
}
