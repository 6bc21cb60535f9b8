// Four neighbouring texels each trace a quarter of the cones (trace_cones); their mean covers all of them. A tent
// over 3 x 3 texels weights the four quarters equally; texels whose surface does not continue this one's are left
// out.
#include "common/low_res_grid.glsl"
#include "common/continuation.glsl"

#include "common/pixel_group.glsl"
uniform sampler2D traced_rho;
#pragma texels rgba16f traced_rho
#ifdef BENT
uniform sampler2D traced_change;   // of what was traced, by transparent objects (refract_cones.comp.glsl)
#pragma texels rgba16f traced_change
#endif
layout(rgba16f) writeonly uniform image2D irradiance_rho;
#ifdef REAL
uniform sampler2D traced_mu;                        // a: 1 where traced
#pragma texels rgba16f traced_mu
layout(rgba16f) writeonly uniform image2D irradiance_mu;
#endif
#ifdef REUSES
uniform usampler2D stale_texels;   // the others hold means already
#endif
#include "common/camera.glsl"

float tent(ivec2 o) { return float((2 - abs(o.x)) * (2 - abs(o.y))); }

vec4 rho_of(ivec2 texel) {
    vec4 rho = texelFetch(traced_rho, texel, 0);
#ifdef BENT
    rho.rgb = max(rho.rgb + texelFetch(traced_change, texel, 0).rgb, vec3(0.0));
#endif
    return rho;
}

bool traced(ivec2 texel) {
    if (any(lessThan(texel, ivec2(0))) || any(greaterThanEqual(texel, low_resolution_size))) return false;
#ifdef REAL
    return texelFetch(traced_mu, texel, 0).a > 0.0;
#else
    return texelFetch(traced_rho, texel, 0).a > 0.0;
#endif
}

void average(ivec2 texel, inout vec3 mu, inout vec3 rho) {
    SurfacePoint s = surface_point(texel);
    float near = sample_distance * distance(s.position, camera_position), total = 0.0;
    mu = rho = vec3(0.0);
    for (int i = 0; i < 9; ++i) {
        ivec2 o = ivec2(i % 3, i / 3) - 1, at = texel + o;
        if (!traced(at)) continue;
        SurfacePoint other = surface_point(at);
        float w = tent(o) * continuation(s.position, s.normal, other.position, other.normal, near);
        total += w;
        rho += w * rho_of(at).rgb;
#ifdef REAL
        mu += w * texelFetch(traced_mu, at, 0).rgb;
#endif
    }
    mu /= total;   // its own weight is 4
    rho /= total;
}

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, low_resolution_size))) return;
    vec4 rho = rho_of(texel), mu = vec4(0.0);
#ifdef REAL
    mu = texelFetch(traced_mu, texel, 0);
#endif
#ifdef REUSES
#ifdef REAL
    const uint fresh = 1u;
#else
    const uint fresh = 2u;
#endif
    bool is_mean = (texelFetch(stale_texels, texel, 0).r & fresh) == 0u;
#else
    const bool is_mean = false;
#endif
    if (traced(texel) && !is_mean) average(texel, mu.rgb, rho.rgb);
    imageStore(irradiance_rho, texel, rho);
#ifdef REAL
    imageStore(irradiance_mu, texel, mu);
#endif
}
