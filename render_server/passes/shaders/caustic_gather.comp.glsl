// Irradiance of the wide beams at each texel of the reduced grid; a workgroup per tile of 8 x 8 texels. It picks the beams
// that may reach the tile 64 at a time. Sums are integers, so that the order of the beams does not matter.
#include "common/geometry.glsl"
#define ADDS_CAUSTICS
#include "common/beam_footprint.glsl"
#include "common/camera.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
uniform isampler2D sample_pixels;
uniform ivec2 picture_pixels;
#ifdef REUSES
uniform usampler2D stale_texels;   // REAL and OBJECT where light must be computed
#endif

const uint REAL = 1u, OBJECT = 2u;

shared uint wanted;                // of the tile's texels
shared uint picked_count;
shared uint picked[64];

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

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy), tile = 8 * ivec2(gl_WorkGroupID.xy);
    bool inside = all(lessThan(texel, textureSize(sample_pixels, 0)));
    ivec4 pixels = inside ? texelFetch(sample_pixels, texel, 0) : ivec4(-1);
    uint needed = inside ? needs(texel, pixels) : 0u;
    if (gl_LocalInvocationIndex == 0u) wanted = 0u;
    memoryBarrierShared();
    barrier();
    if (needed != 0u) atomicOr(wanted, needed);
    memoryBarrierShared();
    barrier();
    if (wanted == 0u) return;
    vec3 normal[2], p[2];
    p[0] = position_on(REAL_LAYER, max(pixels.xy, ivec2(0)), normal[0]);
    p[1] = position_on(OBJECT_LAYER, max(pixels.zw, ivec2(0)), normal[1]);
    ivec3 sum[2] = ivec3[2](ivec3(0), ivec3(0));
    uint count = min(beam_count, uint(beams.length()));
    for (uint first = 0u; first < count; first += 64u) {
        if (gl_LocalInvocationIndex == 0u) picked_count = 0u;
        memoryBarrierShared();
        barrier();
        pick(first + gl_LocalInvocationIndex, count, tile);
        memoryBarrierShared();
        barrier();
        for (uint j = 0u; j < picked_count; ++j) {
            Beam beam = beams[picked[j]];
            BeamPlace at = places[picked[j]];
            int k = at.layer == REAL_LAYER ? 0 : 1;
            if ((needed & (1u << k)) == 0u || any(lessThan(texel, at.low)) || any(greaterThan(texel, at.high))) continue;
            sum[k] += caustic_part(beam, basis_around(beam.direction.xyz), p[k], normal[k]);
        }
        barrier();
    }
    if ((needed & REAL) != 0u) store(texel, REAL_LAYER, sum[0]);
    if ((needed & OBJECT) != 0u) store(texel, OBJECT_LAYER, sum[1]);
}
