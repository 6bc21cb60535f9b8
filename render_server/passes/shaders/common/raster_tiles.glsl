// Square tiles of a raster, of TILE texels an edge, row by row, and what is marked in them. Texels' centres are at integers.
const int TILE = 2;
const uint UNEVEN = 1u;   // the samples of a pixel there may differ
const uint THIN = 2u;     // something there may be thinner than a texel
const float REACH = 0.45;   // texels from a pixel's place to its furthest sample along an axis: less than half of one
uniform ivec2 raster_size;

ivec2 tile_of(vec2 place) { return clamp(ivec2(floor(place + 0.5)), ivec2(0), raster_size - 1) / TILE; }

int tile_number(ivec2 tile) { return tile.y * ((raster_size.x + TILE - 1) / TILE) + tile.x; }
