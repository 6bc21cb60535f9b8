// Irradiance of the wide beams at each texel of the reduced grid; a workgroup per tile, ROWS of its texels for each invocation. Sums
// are integers, so that the order of the beams does not matter.
#include "common/geometry.glsl"
#define ADDS_CAUSTICS
#include "common/beam_footprint.glsl"
#include "common/beam_tiles.glsl"
#include "common/camera.glsl"

layout(local_size_x = 8, local_size_y = GROUP_ROWS) in;
uniform ivec2 picture_pixels;
layout(std430) readonly buffer TileBeams { uint tile_beams[]; };

void gather(inout ivec3 sum, LitTexel t, ivec2 place, Beam beam, ivec4 bounds, mat3 basis) {
    bool reached = all(greaterThanEqual(place, bounds.xy)) && all(lessThanEqual(place, bounds.zw));
    if (reached) sum += caustic_part(beam, basis, t.p, t.normal);
}

void store(ivec3 sum, ivec2 place, int layer) {
    int at = sums_of_texel(place, textureSize(sample_pixels, 0), picture_pixels) + layer;
    for (int j = 0; j < 3; ++j) caustic_sums[at + j] = sum[j];
}

// Gathers the light of one layer in the tile, at this invocation's texels.
void gather_layer(ivec2 tile, int layer) {
    ivec2 first = TILE * tile + ivec2(gl_LocalInvocationID.xy);
    LitTexel held[ROWS];
    ivec3 sums[ROWS];
    for (int i = 0; i < ROWS; ++i) {
        held[i] = lit_texel(first + ivec2(0, i * GROUP_ROWS), layer);
        sums[i] = ivec3(0);
    }
    int base = first_word(tile, layer);
    uint count = beams_held();
    for (uint word = 0u; 32u * word < count; ++word) {
        uint bits = tile_beams[base + int(word)];
        while (bits != 0u) {
            uint beam_index = 32u * word + uint(findLSB(bits));
            bits &= bits - 1u;
            Beam beam = beam_at(beam_index);
            ivec4 bounds = bounds_of_beam(beam_index);
            mat3 basis = basis_around(beam.direction.xyz);
            for (int i = 0; i < ROWS; ++i) gather(sums[i], held[i], first + ivec2(0, i * GROUP_ROWS), beam, bounds, basis);
        }
    }
    for (int i = 0; i < ROWS; ++i) if (held[i].needed) store(sums[i], first + ivec2(0, i * GROUP_ROWS), layer);
}

// One call in a loop: drivers compile every call anew.
void main() {
    int layer = REAL_LAYER;
    do gather_layer(ivec2(gl_WorkGroupID.xy), layer); while ((layer += OBJECT_LAYER - REAL_LAYER) <= OBJECT_LAYER);
}
