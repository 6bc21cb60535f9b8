// Irradiance of the wide beams at each texel of the reduced grid; a workgroup per tile of 8 x 8 texels, ROWS of them
// for each invocation. It picks the beams that may reach the tile, one for each invocation at a time. Sums are integers, so that
// the order of the beams does not matter.
#include "common/geometry.glsl"
#define ADDS_CAUSTICS
#include "common/beam_footprint.glsl"
#include "common/camera.glsl"
#include "common/lit_pixels.glsl"

layout(local_size_x = 8, local_size_y = GROUP_ROWS) in;
const int THREADS = 64 / ROWS;
uniform isampler2D sample_pixels;
#pragma texels rgba16i sample_pixels
uniform ivec2 picture_pixels;
#ifdef REUSES
uniform usampler2D stale_texels;   // REAL and OBJECT where light must be computed
#endif

const uint REAL = 1u, OBJECT = 2u;

shared uint wanted;                // of the tile's texels
shared uint picked_count;
shared uint picked[THREADS];

// What light this texel needs.
uint needs(ivec2 texel) {
    if (any(greaterThanEqual(texel, textureSize(sample_pixels, 0)))) return 0u;
    ivec4 pixels = lit_pixels(texelFetch(sample_pixels, texel, 0));
    uint found = (pixels.x >= 0 ? REAL : 0u) | (pixels.z >= 0 ? OBJECT : 0u);
#ifdef REUSES
    found &= texelFetch(stale_texels, texel, 0).r;
#endif
    return found;
}

void pick(uint i, uint count, ivec2 tile, int layer) {
    if (i >= count) return;
    BeamPlace at = place_of_beam(i);
    bool meets = all(lessThanEqual(at.low, tile + 7)) && all(greaterThanEqual(at.high, tile));
    if (at.layer == layer && at.sharp == 0 && meets) picked[atomicAdd(picked_count, 1u)] = i;
}

// What a texel has gathered.
struct Texel { ivec2 place; bool needed; vec3 p; vec3 normal; ivec3 sum; };

Texel texel_at(ivec2 place, uint needed, int layer) {
    ivec4 pixels = lit_pixels(texelFetch(sample_pixels, place, 0));
    Texel t;
    t.place = place;
    t.needed = (needed & (layer == REAL_LAYER ? REAL : OBJECT)) != 0u;
    t.p = position_on(layer, max(layer == REAL_LAYER ? pixels.xy : pixels.zw, ivec2(0)), t.normal);
    t.sum = ivec3(0);
    return t;
}

void gather(inout Texel t, Beam beam, ivec4 bounds, mat3 basis) {
    bool reached = all(greaterThanEqual(t.place, bounds.xy)) && all(lessThanEqual(t.place, bounds.zw));
    if (reached) t.sum += caustic_part(beam, basis, t.p, t.normal);
}

void store(Texel t, int layer) {
    if (!t.needed) return;
    int at = sums_of_texel(t.place, textureSize(sample_pixels, 0), picture_pixels) + layer;
    for (int j = 0; j < 3; ++j) caustic_sums[at + j] = t.sum[j];
}

// Gathers the light of one layer in the tile, at this invocation's texels.
void gather_layer(ivec2 tile, uint needed[ROWS], int layer) {
    Texel held[ROWS];
    for (int i = 0; i < ROWS; ++i)
        held[i] = texel_at(tile + ivec2(gl_LocalInvocationID.xy) + ivec2(0, i * GROUP_ROWS), needed[i], layer);
    uint count = beams_held();
    for (uint first = 0u; first < count; first += uint(THREADS)) {
        if (gl_LocalInvocationIndex == 0u) picked_count = 0u;
        memoryBarrierShared();
        barrier();
        pick(first + gl_LocalInvocationIndex, count, tile, layer);
        memoryBarrierShared();
        barrier();
        for (uint j = 0u; j < picked_count; ++j) {
            Beam beam = beam_at(picked[j]);
            ivec4 bounds = bounds_of_beam(picked[j]);
            mat3 basis = basis_around(beam.direction.xyz);
            for (int i = 0; i < ROWS; ++i) gather(held[i], beam, bounds, basis);
        }
        barrier();
    }
    for (int i = 0; i < ROWS; ++i) store(held[i], layer);
}

void main() {
    ivec2 tile = 8 * ivec2(gl_WorkGroupID.xy);
    uint needed[ROWS], any_needed = 0u;
    for (int i = 0; i < ROWS; ++i) {
        needed[i] = needs(tile + ivec2(gl_LocalInvocationID.xy) + ivec2(0, i * GROUP_ROWS));
        any_needed |= needed[i];
    }
    if (gl_LocalInvocationIndex == 0u) wanted = 0u;
    memoryBarrierShared();
    barrier();
    if (any_needed != 0u) atomicOr(wanted, any_needed);
    memoryBarrierShared();
    barrier();
    if ((wanted & REAL) != 0u) gather_layer(tile, needed, REAL_LAYER);
    if ((wanted & OBJECT) != 0u) gather_layer(tile, needed, OBJECT_LAYER);
}
