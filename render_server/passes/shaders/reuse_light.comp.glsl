// Irradiance of cones at objects, or caustics at objects and real surfaces, as the last frame's texels know them.
#include "common/geometry.glsl"
#include "common/reprojection.glsl"
#include "common/last_texels.glsl"
#include "common/lit_pixels.glsl"

#include "common/pixel_group.glsl"
uniform isampler2D sample_pixels;
uniform usampler2D stale_texels;
#pragma texels rgba16i sample_pixels
#ifdef CAUSTICS
#define ADDS_CAUSTICS
#include "common/caustic_sums.glsl"
layout(std430) readonly buffer LastSums { int last_sums[]; };
#else
uniform sampler2D last_irradiance;
layout(rgba16f) writeonly uniform image2D irradiance;
#endif

void reuse(ivec2 texel, int layer, vec4 position, vec3 normal) {
    LastTexels last = last_texels(position, normal, layer != 0);
    vec4 sum = vec4(0.0);
    for (int j = 0; j < 4; ++j) {
        if (last.weights[j] == 0.0) continue;
        ivec2 from = last.base + ivec2(j & 1, j >> 1);
#ifdef CAUSTICS
        int at = sums_of_texel(from, textureSize(sample_pixels, 0), ivec2(picture_size)) + layer;
        sum.rgb += last.weights[j] * vec3(last_sums[at], last_sums[at + 1], last_sums[at + 2]);
#else
        sum += last.weights[j] * texelFetch(last_irradiance, from, 0);
#endif
    }
#ifdef CAUSTICS
    int to = sums_of_texel(texel, textureSize(sample_pixels, 0), ivec2(picture_size)) + layer;
    for (int i = 0; i < 3; ++i) caustic_sums[to + i] = int(round(sum[i]));
#else
    imageStore(irradiance, texel, vec4(sum.rgb, 1.0));
#endif
}

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, textureSize(sample_pixels, 0)))) return;
    ivec4 pixels = lit_pixels(texelFetch(sample_pixels, texel, 0));
    uint stale = texelFetch(stale_texels, texel, 0).r;
#ifdef CAUSTICS
    if (pixels.x >= 0 && (stale & STALE_REAL) == 0u)
        reuse(texel, REAL_LAYER, texelFetch(real_surface_position, pixels.xy, 0), texelFetch(real_surface_normal, pixels.xy, 0).xyz);
#endif
    ivec2 raster = raster_texel(max(pixels.zw, ivec2(0)));
    if (pixels.z >= 0 && (stale & STALE_OBJECT) == 0u)
        reuse(texel, 3, texelFetch(virtual_raster_position, raster, 0), texelFetch(virtual_raster_normal, raster, 0).xyz);
}
