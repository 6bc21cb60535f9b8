// Irradiance of the wide beams at each texel of the reduced grid; a workgroup per tile of 8 x 8 texels, two of them
// for each invocation. It picks the beams that may reach the tile 32 at a time. Sums are integers, so that the order of the beams does not matter.
#include "common/geometry.glsl"
#define ADDS_CAUSTICS
#include "common/beam_footprint.glsl"
#include "common/camera.glsl"

layout(local_size_x = 8, local_size_y = 4) in;
uniform isampler2D sample_pixels;
uniform ivec2 picture_pixels;
#ifdef REUSES
uniform usampler2D stale_texels;   // REAL and OBJECT where light must be computed
#endif

const uint REAL = 1u, OBJECT = 2u;

shared uint wanted;                // of the tile's texels
shared uint picked_count;
shared uint picked[32];

// What light this texel needs.
uint needs(ivec2 texel, ivec4 pixels) {
    uint found = (pixels.x >= 0 ? REAL : 0u) | (pixels.z >= 0 ? OBJECT : 0u);
#ifdef REUSES
    found &= texelFetch(stale_texels, texel, 0).r;
#endif
    return found;
}

void pick(uint i, uint count, ivec2 tile) {
    if (i >= count) return;
    BeamPlace at = places[i];
    bool meets = all(lessThanEqual(at.low, tile + 7)) && all(greaterThanEqual(at.high, tile));
    uint layer = at.layer == REAL_LAYER ? REAL : OBJECT;
    if (at.layer >= 0 && at.sharp == 0 && meets && (wanted & layer) != 0u) picked[atomicAdd(picked_count, 1u)] = i;
}

void store(ivec2 texel, int layer, ivec3 sum) {
    int at = sums_of_texel(texel, textureSize(sample_pixels, 0), picture_pixels) + layer;
    for (int j = 0; j < 3; ++j) caustic_sums[at + j] = sum[j];
}

// What a texel has gathered, at its real surface and at its object.
struct Texel { ivec2 place; uint needed; vec3 p[2]; vec3 normal[2]; ivec3 sum[2]; };

Texel texel_at(ivec2 place) {
    Texel t;
    t.place = place;
    bool inside = all(lessThan(place, textureSize(sample_pixels, 0)));
    ivec4 pixels = inside ? texelFetch(sample_pixels, place, 0) : ivec4(-1);
    t.needed = inside ? needs(place, pixels) : 0u;
    t.p[0] = position_on(REAL_LAYER, max(pixels.xy, ivec2(0)), t.normal[0]);
    t.p[1] = position_on(OBJECT_LAYER, max(pixels.zw, ivec2(0)), t.normal[1]);
    t.sum[0] = t.sum[1] = ivec3(0);
    return t;
}

void gather(inout Texel t, Beam beam, BeamPlace at, mat3 basis) {
    int k = at.layer == REAL_LAYER ? 0 : 1;
    bool reached = all(greaterThanEqual(t.place, at.low)) && all(lessThanEqual(t.place, at.high));
    if (reached && (t.needed & (1u << k)) != 0u) t.sum[k] += caustic_part(beam, basis, t.p[k], t.normal[k]);
}

void store_all(Texel t) {
    if ((t.needed & REAL) != 0u) store(t.place, REAL_LAYER, t.sum[0]);
    if ((t.needed & OBJECT) != 0u) store(t.place, OBJECT_LAYER, t.sum[1]);
}

void main() {
    ivec2 tile = 8 * ivec2(gl_WorkGroupID.xy), place = tile + ivec2(gl_LocalInvocationID.xy);
    Texel one = texel_at(place), other = texel_at(place + ivec2(0, 4));
    if (gl_LocalInvocationIndex == 0u) wanted = 0u;
    memoryBarrierShared();
    barrier();
    if ((one.needed | other.needed) != 0u) atomicOr(wanted, one.needed | other.needed);
    memoryBarrierShared();
    barrier();
    if (wanted == 0u) return;
    uint count = min(beam_count, uint(beams.length()));
    for (uint first = 0u; first < count; first += 32u) {
        if (gl_LocalInvocationIndex == 0u) picked_count = 0u;
        memoryBarrierShared();
        barrier();
        pick(first + gl_LocalInvocationIndex, count, tile);
        memoryBarrierShared();
        barrier();
        for (uint j = 0u; j < picked_count; ++j) {
            Beam beam = beams[picked[j]];
            BeamPlace at = places[picked[j]];
            mat3 basis = basis_around(beam.direction.xyz);
            gather(one, beam, at, basis);
            gather(other, beam, at, basis);
        }
        barrier();
    }
    store_all(one);
    store_all(other);
}
