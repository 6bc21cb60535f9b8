// Finds the tiles that each wide beam may light: invocations (x) walk the beams for each row of tiles (y).
#include "common/geometry.glsl"
#include "common/beam_footprint.glsl"
#include "common/beam_tiles.glsl"
#include "common/walk.glsl"

layout(local_size_x = 64) in;
layout(rgba32f) readonly uniform image2D tile_balls;
layout(std430) buffer TileBeams { uint tile_beams[]; };

void mark(uint i, int row) {
    BeamPlace at = place_of_beam(i);
    ivec2 low = at.low / TILE, high = at.high / TILE;
    if (at.layer < 0 || at.sharp != 0 || row < low.y || row > high.y) return;
    Beam beam = beam_at(i);
    int below = at.layer == REAL_LAYER ? 0 : tiles.y;
    for (int x = low.x; x <= high.x; ++x)
        if (may_light(beam, imageLoad(tile_balls, ivec2(x, row + below))))
            atomicOr(tile_beams[first_word(ivec2(x, row), at.layer) + int(i >> 5u)], 1u << (i & 31u));
}

void main() {
    uint count = beams_held();
    for (uint i = first_item(); i < count; i += items_apart()) mark(i, int(gl_WorkGroupID.y));
}
