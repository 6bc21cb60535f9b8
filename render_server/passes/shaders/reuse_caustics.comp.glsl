// Caustics at objects and real surfaces, as the last frame's texels know them.
#include "common/geometry.glsl"
#include "common/reprojection.glsl"
#include "common/last_texels.glsl"
#include "common/lit_pixels.glsl"

#include "common/pixel_group.glsl"
uniform isampler2D sample_pixels;
uniform usampler2D stale_texels;
#pragma texels rgba16i sample_pixels
#define ADDS_CAUSTICS
#include "common/caustic_sums.glsl"
layout(std430) readonly buffer LastSums { int last_sums[]; };

int sums_at(ivec2 texel) { return sums_of_texel(texel, textureSize(sample_pixels, 0), ivec2(picture_size)); }

void reuse(ivec2 texel, int layer, vec4 position, vec3 normal) {
    LastTexels last = last_texels(position, normal, layer != 0);
    vec3 sum = vec3(0.0);
    for (int j = 0; j < 4; ++j) {
        if (last.weights[j] == 0.0) continue;
        int at = sums_at(last.base + ivec2(j & 1, j >> 1)) + layer;
        sum += last.weights[j] * vec3(last_sums[at], last_sums[at + 1], last_sums[at + 2]);
    }
    int to = sums_at(texel) + layer;
    for (int i = 0; i < 3; ++i) caustic_sums[to + i] = int(round(sum[i]));
}

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, textureSize(sample_pixels, 0)))) return;
    ivec4 pixels = lit_pixels(texelFetch(sample_pixels, texel, 0));
    uint stale = texelFetch(stale_texels, texel, 0).r;
    if (pixels.x >= 0 && (stale & STALE_REAL) == 0u)
        reuse(texel, REAL_LAYER, texelFetch(real_surface_position, pixels.xy, 0), texelFetch(real_surface_normal, pixels.xy, 0).xyz);
    ivec2 raster = raster_texel(max(pixels.zw, ivec2(0)));
    if (pixels.z >= 0 && (stale & STALE_OBJECT) == 0u)
        reuse(texel, 3, texelFetch(virtual_raster_position, raster, 0), texelFetch(virtual_raster_normal, raster, 0).xyz);
}
