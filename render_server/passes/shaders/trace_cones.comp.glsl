// Diffuse and specular cones of the exact operator at 1/scale of the picture (docs/method.md 3.2, 4.5). REAL: E_mu and
// E_rho of ambient and bounced light at real surfaces, without and with the objects. Otherwise: E_rho at the objects.
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
layout(rgba16f) writeonly uniform image2D irradiance_rho;   // rgb E_rho; a: volume fade (REAL), 1 where traced (otherwise)
layout(rgba16f) writeonly uniform image2D specular_rho;     // rgb mean radiance of the specular lobe
#ifdef REAL
layout(rgba16f) writeonly uniform image2D irradiance_mu;    // rgb E_mu, a: 1 where traced
layout(rgba16f) writeonly uniform image2D specular_mu;      // as specular_rho, without the objects
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
#include "common/camera.glsl"

// Whether the irradiance must be traced, because nothing usable is kept of the last frame's.
#ifdef REUSES
uniform usampler2D stale_texels;
bool is_stale(ivec2 texel) { return (texelFetch(stale_texels, texel, 0).r & 2u) != 0u; }
#else
bool is_stale(ivec2 texel) { return true; }
#endif

// Mean radiance of a cone without (mu) and with the objects (rho).
struct SpecularCone { vec3 mu; vec3 rho; };

SpecularCone specular_cone(vec3 q, vec3 direction, float half_angle) {
    March m = march(q, direction, 2.0 * tan(half_angle), false);
    vec3 beyond = environment(direction, half_angle);
    return SpecularCone(m.c_mu + m.t_mu * beyond, m.c_rho + m.t_rho * beyond);
}

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
        sum += reflected * specular_cone(q, d, half_angle).rho;
        total += reflected;
    }
    return sum / max(total, vec3(1e-6));
}
#endif

#ifdef EXTENDED
#define COATED
#include "common/shown_coating.glsl"

// A cone for the base's lobe and one for the coat's, weighted by what they reflect.
vec3 coated_specular(ivec2 texel, SurfacePoint s, vec3 q) {
    ivec2 raster = raster_texel(texelFetch(sample_pixels, texel, 0).zw);
    Material m = coated_material(raster);
    vec3 v = normalize(camera_position - s.position), coat = coat_fraction(reflected_towards(m, s.normal, v)), sum = vec3(0.0);
    int k = 0, lobes = m.over.coat > 0.0 ? 2 : 1;
    do {
        vec3 d = reflect(-v, k == 0 ? s.normal : coat_normal(m.over, s.normal));
        float half_angle = specular_half_angle(k == 0 ? m.roughness : m.over.roughness);
        sum += (k == 0 ? 1.0 - coat : coat) * specular_cone(q, d, half_angle).rho;
    } while (++k < lobes);
    return sum;
}
#endif
#endif

// The specular lobe at a texel by one cone, or one for each of the material's lobes; black without a lobe.
SpecularCone specular_lobe(ivec2 texel, SurfacePoint s, vec3 q) {
    SpecularCone lobe = SpecularCone(vec3(0.0), vec3(0.0));
    bool reflects = s.roughness >= 0.0;
#ifdef MEASURED
    int row = measured_row(texel);
    if (row >= 0) {
        lobe.rho = measured_specular(s, q, row);
        reflects = false;
    }
#endif
#ifdef COATED
    if (reflects) lobe.rho = coated_specular(texel, s, q);
#else
    if (reflects) {
        vec3 mirrored = reflect(-normalize(camera_position - s.position), s.normal);
        lobe = specular_cone(q, mirrored, specular_half_angle(s.roughness));
    }
#endif
    return lobe;
}

void trace(ivec2 texel) {
    SurfacePoint s = surface_point(texel);
    enter_volume(s.position);
    vec3 q = volume_coordinate(s.position), e_mu, e_rho;
#ifdef REAL
    diffuse(q, s.normal, cones_of(texel), false, e_mu, e_rho);
    e_rho = with_further_bounces(e_mu, e_rho, q, s.normal);
    SpecularCone specular = specular_lobe(texel, s, q);
    imageStore(irradiance_mu, texel, vec4(e_mu, 1.0));
    imageStore(irradiance_rho, texel, vec4(e_rho, volume_fade(q)));
    imageStore(specular_mu, texel, vec4(specular.mu, 1.0));
#else
    start_on(s.normal, s.two_sided);
    if (is_stale(texel)) diffuse(q, s.normal, cones_of(texel), true, e_mu, e_rho);
    SpecularCone specular = specular_lobe(texel, s, q);
    if (is_stale(texel)) imageStore(irradiance_rho, texel, vec4(e_rho, 1.0));
#endif
    imageStore(specular_rho, texel, vec4(specular.rho, 1.0));
}

// The texels that low_res_grid or stale_texels listed.
void main() {
    uint i = first_item();
    if (i < listed_count()) do trace(texel_of_index(texels[i], low_resolution_size.x));
    while ((i += items_apart()) < listed_count());
}
