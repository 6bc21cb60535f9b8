// WIDE: finds the tiles that each wide beam may light: invocations (x) walk the beams for each row of tiles (y). NARROW: workgroups
// (below these rows) add the irradiance of narrow beams to the pixels around their hits, a workgroup per beam. With both it is one
// dispatch, for neither waits for the other. Sums are integers, so that their order does not matter.
#include "common/geometry.glsl"
#ifdef NARROW
#define ADDS_CAUSTICS
#endif
#include "common/beam_footprint.glsl"
#include "common/beam_tiles.glsl"
#include "common/camera.glsl"
#include "common/walk.glsl"

layout(local_size_x = 64) in;
layout(rgba32f) readonly uniform image2D tile_balls;
layout(std430) buffer TileBeams { uint tile_beams[]; };
uniform ivec2 picture_pixels;

#ifdef WIDE
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
#endif

#ifdef NARROW
void splat(Beam beam, BeamPlace place) {
    mat3 basis = basis_around(beam.direction.xyz);
    ivec2 size = place.high - place.low + 1;
    for (int i = int(gl_LocalInvocationIndex); i < size.x * size.y; i += 64) {
        ivec2 pixel = place.low + ivec2(i % size.x, i / size.x);
        vec3 normal, p = position_on(place.layer, pixel, normal);
        ivec3 part = caustic_part(beam, basis, p, normal);
        int at = sums_of_pixel(pixel, picture_pixels) + place.layer;
        for (int j = 0; j < 3; ++j)
            if (part[j] != 0) atomicAdd(caustic_sums[at + j], part[j]);
    }
}
#endif

void main() {
    uint count = beams_held(), row = gl_WorkGroupID.y, rows = gl_NumWorkGroups.y;
#ifdef WIDE
    if (row < uint(tiles.y)) {
        for (uint i = first_item(); i < count; i += items_apart()) mark(i, int(row));
        return;
    }
    row -= uint(tiles.y);
    rows -= uint(tiles.y);
#endif
#ifdef NARROW
    for (uint i = row * gl_NumWorkGroups.x + gl_WorkGroupID.x; i < count; i += rows * gl_NumWorkGroups.x) {
        BeamPlace place = place_of_beam(i);
        if (place.layer >= 0 && place.sharp != 0) splat(beam_at(i), place);
    }
#endif
}
