// Diffuse and specular cones of the exact operator at 1/scale of the picture (docs/method.md 3, 4.5).
// REAL: E_mu and E_rho of ambient + bounced light on real surfaces. VIRTUAL: E_rho and the specular cone of the object.
#ifndef REAL
#define TWO_SIDED_STARTS
#endif
#include "common/march.glsl"
#include "common/environment.glsl"
#include "common/diffuse_cones.glsl"
#include "common/brdf.glsl"
#include "common/low_res_grid.glsl"
#include "common/work_list.glsl"

layout(local_size_x = 64) in;
#ifdef REAL
layout(rgba16f) writeonly uniform image2D irradiance_mu;    // rgb E_mu, a: 1 where traced
layout(rgba16f) writeonly uniform image2D irradiance_rho;   // rgb E_rho, a: volume fade
#else
layout(rgba16f) writeonly uniform image2D irradiance_rho;   // rgb E_rho, a: 1 where traced
#endif
#ifdef REAL
layout(rgba16f) writeonly uniform image2D specular_mu;      // rgb mean radiance of the specular cone
#define READS_TAIL
#include "common/bounce_tail.glsl"
#include "common/least_change.glsl"

vec3 with_further_bounces(vec3 e_mu, vec3 e_rho, vec3 q, vec3 n) {
    if (!inside_volume(q)) return e_rho;
    vec3 further = tail_irradiance(q, n);
    bool seen = any(greaterThan(abs(further), LEAST_CHANGE * e_mu));
    return seen ? max(e_rho + further, vec3(0.0)) : e_rho;
}
#endif
layout(rgba16f) writeonly uniform image2D specular_rho;
#include "common/camera.glsl"

// Four adjacent texels share four times as many directions, each cone half as wide as its own solid angle;
// bilateral_cone_filter takes the mean.
ConeSet cones_of(ivec2 texel) { return ConeSet(4, (texel.x & 1) + 2 * (texel.y & 1), 0.5, 0.0); }

#ifdef REUSES
uniform usampler2D stale_texels;
// Whether the last frame does not know the irradiance.
bool is_fresh(ivec2 texel) { return (texelFetch(stale_texels, texel, 0).r & 2u) != 0u; }
#else
bool is_fresh(ivec2 texel) { return true; }
#endif

#ifndef REAL
#pragma switch MEASURED
#ifdef MEASURED
#include "common/measured.glsl"

int measured_row(ivec2 texel) {
    ivec2 pixel = raster_texel(texelFetch(sample_pixels, texel, 0).zw);
    return int(materials[int(texelFetch(virtual_raster_normal, pixel, 0).w)].flags.y) - 1;
}

// A cone for each lobe, weighted by what the lobe reflects.
vec3 measured_specular(SurfacePoint s, vec3 q, int row) {
    vec3 v = normalize(camera_position - s.position), d = reflect(-v, s.normal), sum = vec3(0.0), total = vec3(0.0);
    for (int k = 0; k < int(measured_base(row).a); ++k) {
        vec3 reflected = lobe_albedo_of(row, k, dot(s.normal, v));
        float half_angle = lobe_widths(row, k).y;
        March m = march(q, d, 2.0 * tan(half_angle), false);
        sum += reflected * (m.c_rho + m.t_rho * environment(d, half_angle));
        total += reflected;
    }
    return sum / max(total, vec3(1e-6));
}
#endif
#endif

#ifndef REAL
#ifdef EXTENDED
#include "common/shown_coating.glsl"

// A cone for the base's lobe and one for the coat's, weighted by what they reflect.
vec3 coated_specular(ivec2 texel, SurfacePoint s, vec3 q) {
    ivec2 raster = raster_texel(texelFetch(sample_pixels, texel, 0).zw);
    Material m = coated_material(raster);
    vec3 v = normalize(camera_position - s.position), share = coat_share(reflected_towards(m, s.normal, v)), sum = vec3(0.0);
    int k = 0, lobes = m.over.coat > 0.0 ? 2 : 1;
    do {
        vec3 d = reflect(-v, k == 0 ? s.normal : coat_normal(m.over, s.normal));
        float half_angle = specular_half_angle(k == 0 ? m.roughness : m.over.roughness);
        March met = march(q, d, 2.0 * tan(half_angle), false);
        sum += (k == 0 ? 1.0 - share : share) * (met.c_rho + met.t_rho * environment(d, half_angle));
    } while (++k < lobes);
    return sum;
}
#endif
#endif

void trace(ivec2 texel) {
    SurfacePoint s = surface_point(texel);
    enter_volume(s.position);
    vec3 q = volume_coordinate(s.position);
    vec3 e_mu, e_rho, c_mu = vec3(0.0), c_rho = vec3(0.0);
#ifdef REAL
    diffuse(q, s.normal, cones_of(texel), false, e_mu, e_rho);
    e_rho = with_further_bounces(e_mu, e_rho, q, s.normal);
#else
    start_on(s.normal, s.two_sided);
    if (is_fresh(texel)) diffuse(q, s.normal, cones_of(texel), true, e_mu, e_rho);
#endif
#ifdef MEASURED
    int row = measured_row(texel);
    if (row >= 0) {
        c_rho = measured_specular(s, q, row);
        s.roughness = -1.0;
    }
#endif
#ifndef REAL
#ifdef EXTENDED
    if (s.roughness >= 0.0) {
        c_rho = coated_specular(texel, s, q);
        s.roughness = -1.0;
    }
#endif
#endif
    if (s.roughness >= 0.0) {
        vec3 v = normalize(camera_position - s.position);
        vec3 d = reflect(-v, s.normal);
        float half_angle = specular_half_angle(s.roughness);
        March m = march(q, d, 2.0 * tan(half_angle), false);
        vec3 r = environment(d, half_angle);
        c_mu = m.c_mu + m.t_mu * r;
        c_rho = m.c_rho + m.t_rho * r;
    }
#ifdef REAL
    imageStore(irradiance_mu, texel, vec4(e_mu, 1.0));
    imageStore(irradiance_rho, texel, vec4(e_rho, volume_fade(q)));
    imageStore(specular_mu, texel, vec4(c_mu, 1.0));
#else
    if (is_fresh(texel)) imageStore(irradiance_rho, texel, vec4(e_rho, 1.0));
#endif
    imageStore(specular_rho, texel, vec4(c_rho, 1.0));
}

// The texels that select_cone_texels or low_res_grid listed.
void main() {
    uint i = first_item();
    if (i < listed_count()) do trace(texel_of_index(texels[i], low_resolution_size.x));
    while ((i += items_apart()) < listed_count());
}
