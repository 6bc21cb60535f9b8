// Four neighbouring texels each trace a quarter of the cones (trace_cones); their mean covers all of them. A tent
// over 3 x 3 texels weights the four quarters equally; texels whose surface does not continue this one's are left
// out. REAL: of real surfaces; where nothing is traced, objects have no influence, and light is the environment's. BOTH: of these, and
// of the objects by workgroups with z = 1. Otherwise: of the objects.
#include "common/environment.glsl"
#include "common/brdf.glsl"
#include "common/low_res_grid.glsl"
#include "common/continuation.glsl"

#include "common/pixel_group.glsl"
#ifdef BOTH
#define FILTERS_REAL
bool at_real = gl_WorkGroupID.z == 0u;
#define EITHER(real, object) (at_real ? (real) : (object))
#elif defined(REAL)
#define FILTERS_REAL
#define EITHER(real, object) real
#else
#define EITHER(real, object) object
#endif
#ifndef REAL
uniform sampler2D traced_objects;
#pragma texels rgba16f traced_objects
layout(rgba16f) writeonly uniform image2D object_irradiance;
#endif
#ifdef FILTERS_REAL
uniform usampler2D cone_reach;   // 1 where cones are traced, or the last frame's light is kept
uniform sampler2D traced_mu;
uniform sampler2D traced_rho;
#pragma texels rgba16f traced_mu traced_rho
#ifdef BENT
uniform sampler2D traced_change;   // of what was traced, by transparent objects (refract_cones.comp.glsl)
#pragma texels rgba16f traced_change
#endif
layout(rgba16f) writeonly uniform image2D irradiance_mu;
layout(rgba16f) writeonly uniform image2D irradiance_rho;
#ifndef BENT
layout(rgba16f) writeonly uniform image2D specular_mu;
layout(rgba16f) writeonly uniform image2D specular_rho;
#endif
#endif
#ifdef REUSES
uniform usampler2D stale_texels;   // the others hold means already
#endif
#include "common/camera.glsl"

float tent(ivec2 o) { return float((2 - abs(o.x)) * (2 - abs(o.y))); }

#ifdef FILTERS_REAL
vec4 real_rho_of(ivec2 texel) {
    vec4 rho = texelFetch(traced_rho, texel, 0);
#ifdef BENT
    rho.rgb = max(rho.rgb + texelFetch(traced_change, texel, 0).rgb, vec3(0.0));
#endif
    return rho;
}
#endif

vec4 rho_of(ivec2 texel) { return EITHER(real_rho_of(texel), texelFetch(traced_objects, texel, 0)); }

vec4 mu_of(ivec2 texel) { return EITHER(texelFetch(traced_mu, texel, 0), vec4(0.0)); }

SurfacePoint point_at(ivec2 texel) { return EITHER(real_point(texel), object_point(texel)); }

bool traced(ivec2 texel) {
    if (any(lessThan(texel, ivec2(0))) || any(greaterThanEqual(texel, low_resolution_size))) return false;
    return EITHER(texelFetch(cone_reach, texel, 0).r != 0u, texelFetch(traced_objects, texel, 0).a > 0.0);
}

void average(ivec2 texel, inout vec3 mu, inout vec3 rho) {
    SurfacePoint s = point_at(texel);
    float near = sample_distance * distance(s.position, camera_position), total = 0.0;
    mu = rho = vec3(0.0);
    for (int i = 0; i < 9; ++i) {
        ivec2 o = ivec2(i % 3, i / 3) - 1, at = texel + o;
        if (!traced(at)) continue;
        SurfacePoint other = point_at(at);
        float w = tent(o) * continuation(s.position, s.normal, other.position, other.normal, near);
        total += w;
        rho += w * rho_of(at).rgb;
        mu += w * mu_of(at).rgb;
    }
    mu /= total;   // its own weight is 4
    rho /= total;
}

#ifdef FILTERS_REAL
// Specular cones where none was traced.
void store_specular(ivec2 texel, vec4 c) {
#ifndef BENT
    imageStore(specular_mu, texel, c);
    imageStore(specular_rho, texel, c);
#endif
}

void store_environment(ivec2 texel, SurfacePoint s) {
    vec3 e = s.present ? environment_irradiance(s.normal) : vec3(0.0);
    vec3 c = vec3(0.0);
    if (s.present && s.roughness >= 0.0)
        c = environment(reflect(normalize(s.position - camera_position), s.normal), specular_half_angle(s.roughness));
    imageStore(irradiance_mu, texel, vec4(e, 0.0));
    imageStore(irradiance_rho, texel, vec4(e, 0.0));
    store_specular(texel, vec4(c, 0.0));
}

void store_real(ivec2 texel, vec4 mu, vec4 rho, bool is_mean) {
    imageStore(irradiance_rho, texel, rho);
    imageStore(irradiance_mu, texel, mu);
    if (is_mean) store_specular(texel, vec4(0.0, 0.0, 0.0, 1.0));   // nothing is kept where surfaces are smooth
}
#endif

#ifndef REAL
void store_object(ivec2 texel, vec4 rho) { imageStore(object_irradiance, texel, rho); }
#endif

// Whether what is kept of the last frame is a mean already.
bool holds_mean(ivec2 texel) {
#ifdef REUSES
    return (texelFetch(stale_texels, texel, 0).r & EITHER(1u, 2u)) == 0u;
#else
    return false;
#endif
}

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, low_resolution_size))) return;
#ifdef FILTERS_REAL
    if (EITHER(!traced(texel), false)) {
        store_environment(texel, real_point(texel));
        return;
    }
#endif
    vec4 rho = rho_of(texel), mu = mu_of(texel);
    bool is_mean = holds_mean(texel);
    if (traced(texel) && !is_mean) average(texel, mu.rgb, rho.rgb);
#ifdef BOTH
    if (at_real) store_real(texel, mu, rho, is_mean);
    else store_object(texel, rho);
#elif defined(REAL)
    store_real(texel, mu, rho, is_mean);
#else
    store_object(texel, rho);
#endif
}
