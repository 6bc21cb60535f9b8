// Irradiance of caustic beams at a pixel: its sharp part, and the smooth part of the reduced grid. Needs
// geometry.glsl.
#include "common/caustic_sums.glsl"
#include "common/upsample.glsl"
#include "common/lit_pixels.glsl"
#include "common/rolled.glsl"

// Whether the sums are bound: llvmpipe executes what they need for every pixel, so that a scene without does without.
#pragma switch bool has_caustics

// `p`, `n`, `depth`: the pixel's surface in that layer.
vec3 caustic_irradiance(ivec2 pixel, ivec2 size, int layer, vec3 p, vec3 n, float depth) {
    if (!has_caustics) return vec3(0.0);
    vec3 smooth_part = vec3(0.0);
    float total = 0.0;
    int texels = layer == REAL_LAYER ? rolled(4) : 4;   // of objects, llvmpipe runs unrolled turns faster
    for (int j = 0; j < texels; ++j) {
        float w;
        ivec2 texel = low_texel(pixel, j, w);
        ivec4 at = lit_pixels(texelFetch(sample_pixels, texel, 0));
        if ((layer == REAL_LAYER ? at.x : at.z) < 0) continue;
        ivec2 raster = raster_texel(at.zw);
        vec3 sp = layer == REAL_LAYER ? texelFetch(real_surface_position, at.xy, 0).xyz : texelFetch(virtual_raster_position, raster, 0).xyz;
        vec3 sn = layer == REAL_LAYER ? texelFetch(real_surface_normal, at.xy, 0).xyz : texelFetch(virtual_raster_normal, raster, 0).xyz;
        w *= continuation(p, n, sp, sn, sample_distance * depth) + 1e-4;
        smooth_part += w * caustic_at(sums_of_texel(texel, textureSize(sample_pixels, 0), size) + layer);
        total += w;
    }
    return caustic_at(sums_of_pixel(pixel, size) + layer) + (total > 0.0 ? smooth_part / total : vec3(0.0));
}
