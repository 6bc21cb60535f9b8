// What a cone sees of the real scene as the camera shows it, lit as the objects leave it. What it does not find in the
// picture it looks up in voxels (VOXELS). Needs brdf.glsl before it: what is included within a condition is not again.
#include "common/screen_march.glsl"
#include "common/upsample.glsl"
#ifdef VOXELS
#include "common/march.glsl"
#include "common/environment.glsl"
#endif

uniform sampler2D direct_mu;
uniform sampler2D direct_rho;
uniform sampler2D cone_mu;
uniform sampler2D cone_rho;
#pragma texels rgba16f direct_mu direct_rho cone_mu cone_rho

const float LEAST_IRRADIANCE = 1e-4;

// E_rho / E_mu where a pixel sees a real surface, also behind objects.
vec3 change_of_light(vec2 at) {
    ivec2 pixel = clamp(ivec2(at), ivec2(0), textureSize(direct_mu, 0) - 1);
    vec3 mu = vec3(0.0), rho = vec3(0.0);
    float total = 0.0;
    for (int j = 0; j < 4; ++j) {
        float w;
        ivec2 texel = low_texel(pixel, j, w);
        if (texelFetch(sample_pixels, texel, 0).x == -1) continue;
        vec4 e_mu = texelFetch(cone_mu, texel, 0), e_rho = texelFetch(cone_rho, texel, 0);
        mu += w * e_mu.rgb;
        rho += w * mix(e_mu.rgb, e_rho.rgb, e_rho.a);
        total += w;
    }
    if (total == 0.0) return vec3(1.0);
    mu = mu / total + texelFetch(direct_mu, pixel, 0).rgb;
    rho = rho / total + texelFetch(direct_rho, pixel, 0).rgb;
    return (max(rho, vec3(0.0)) + LEAST_IRRADIANCE) / (mu + LEAST_IRRADIANCE);
}

// Radiance times fraction of a cone's hit in the picture.
vec4 shown_at(ScreenHit hit, float spread) {
    return hit.fraction * vec4(screen_radiance(hit, spread) * change_of_light(hit.pixel), 1.0);
}

#ifdef VOXELS
// Radiance of all that a cone may meet, objects too, at the resolution of the voxels; `open`: the fraction that meets nothing.
vec3 look_in_voxels(vec3 from, vec3 d, float spread, out float open) {
    bool differs;
    enter_volume(from);
    Crossed met = march_one(mipmap_rho, volume_coordinate(from), d, spread, differs);
    open = 1.0 - blocked_fraction(met.coverage);
    return met.c + open * environment(d, atan(0.5 * spread));
}
#endif
