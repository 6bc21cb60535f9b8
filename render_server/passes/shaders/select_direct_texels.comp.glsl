// Lists the texels of the reduced grid in which direct light must be computed at a pixel, and empties the others where
// objects do not reach. With REUSES, texels whose pixels' light the last frame knows are left out too; and in turn one
// tile in `turns` is computed, so that errors of resampling do not add up.
#include "common/light_reach.glsl"
#define APPENDS_TEXELS
#include "common/work_list.glsl"
#ifdef REUSES
#include "common/reprojection.glsl"
#endif

layout(local_size_x = 8, local_size_y = 8) in;
layout(rgba16f) restrict uniform image2D direct_mu;    // as in direct_light.comp.glsl
layout(rgba16f) restrict uniform image2D direct_rho;
layout(rgba16f) writeonly uniform image2D lobe_mu;
layout(rgba16f) writeonly uniform image2D lobe_rho;
#pragma switch bool specular_surfaces
uniform ivec2 low_resolution_size;
uniform int scale;

bool needs_light(ivec2 pixel) {
#ifdef REUSES
    if (has_history && imageLoad(direct_rho, pixel).a > 0.0) return false;
#endif
    vec4 position = texelFetch(real_surface_position, pixel, 0);
    return light_may_change(pixel, position, texelFetch(real_surface_normal, pixel, 0).xyz);
}

void empty(ivec2 pixel) {
#ifndef REUSES
    imageStore(direct_mu, pixel, vec4(0.0));
    imageStore(direct_rho, pixel, vec4(0.0));
#endif
    if (specular_surfaces) {
        imageStore(lobe_mu, pixel, vec4(0.0));
        imageStore(lobe_rho, pixel, vec4(0.0));
    }
}

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy), size = textureSize(real_surface_position, 0);
    if (any(greaterThanEqual(texel, low_resolution_size))) return;
    bool needed = false;
#ifdef REUSES
    needed = is_due(texel);
#endif
    for (int i = 0; i < scale * scale && !needed; ++i) {
        ivec2 pixel = pixel_in_block(texel, i, scale);
        needed = all(lessThan(pixel, size)) && needs_light(pixel);
    }
    if (needed) append_texel(texel, low_resolution_size.x);
    for (int i = 0; i < (needed ? 0 : scale * scale); ++i) {
        ivec2 pixel = pixel_in_block(texel, i, scale);
        if (all(lessThan(pixel, size))) empty(pixel);
    }
}
