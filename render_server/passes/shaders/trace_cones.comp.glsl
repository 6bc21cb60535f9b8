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
        March m = march(q, d, 2.0 * tan(half_angle), true);
        sum += reflected * (m.c_rho + m.t_rho * environment(d, half_angle));
        total += reflected;
    }
    return sum / max(total, vec3(1e-6));
}
#endif

#ifdef EXTENDED
#define COATED
#include "common/shown_coating.glsl"

// The base's lobe and the coat's, weighted by what they reflect; how many there are.
int coated_lobes(ivec2 texel, SurfacePoint s, out Lobe base, out Lobe coat) {
    ivec2 raster = raster_texel(texelFetch(sample_pixels, texel, 0).zw);
    Material m = coated_material(raster);
    vec3 v = normalize(camera_position - s.position), fraction = coat_fraction(reflected_towards(m, s.normal, v));
    base = lobe_along(reflect(-v, s.normal), specular_half_angle(m.roughness), 1.0 - fraction);
    coat = lobe_along(reflect(-v, coat_normal(m.over, s.normal)), specular_half_angle(m.over.roughness), fraction);
    return m.over.coat > 0.0 ? 2 : 1;
}
#endif
#endif

// The lobes of the surface at a texel, if it reflects; how many there are.
int lobes_at(ivec2 texel, SurfacePoint s, out Lobe base, out Lobe coat) {
#ifdef COATED
    int lobes = coated_lobes(texel, s, base, coat);
#else
    vec3 mirrored = reflect(-normalize(camera_position - s.position), s.normal);
    base = coat = lobe_along(mirrored, specular_half_angle(s.roughness), vec3(1.0));
    int lobes = 1;
#endif
    return s.roughness >= 0.0 ? lobes : 0;
}

void trace(ivec2 texel) {
    SurfacePoint s = surface_point(texel);
    enter_volume(s.position);
    vec3 q = volume_coordinate(s.position);
    Lobe base, coat;
    int lobes = lobes_at(texel, s, base, coat);
#ifdef REAL
    Gathered found = gather_cones(q, s.normal, cones_of(texel), false, 0, lobes, base, coat);
    found.e_rho = with_further_bounces(found.e_mu, found.e_rho, q, s.normal);
    imageStore(irradiance_mu, texel, vec4(found.e_mu, 1.0));
    imageStore(irradiance_rho, texel, vec4(found.e_rho, volume_fade(q)));
    imageStore(specular_mu, texel, vec4(found.lobe_mu, 1.0));
#else
    start_on(s.normal, s.two_sided);
    bool stale = is_stale(texel);
#ifdef MEASURED
    int row = measured_row(texel);
    if (row >= 0) lobes = 0;
#endif
    Gathered found = gather_cones(q, s.normal, cones_of(texel), true, stale ? 0 : cone_count, lobes, base, coat);
#ifdef MEASURED
    if (row >= 0) found.lobe_rho = measured_specular(s, q, row);
#endif
    if (stale) imageStore(irradiance_rho, texel, vec4(found.e_rho, 1.0));
#endif
    imageStore(specular_rho, texel, vec4(found.lobe_rho, 1.0));
}

// The texels that low_res_grid or stale_texels listed.
void main() {
    uint i = first_item();
    if (i < listed_count()) do trace(texel_of_index(texels[i], low_resolution_size.x));
    while ((i += items_apart()) < listed_count());
}
