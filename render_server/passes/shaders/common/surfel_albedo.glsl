// Albedo of surfels: of real ones (REAL), of the objects', or of BOTH. Needs voxel_store.glsl, environment.glsl.
#include "common/brdf.glsl"
#include "common/albedo_range.glsl"

#ifdef REAL
#include "common/lights.glsl"
#include "common/real_radiance.glsl"
uniform float bias_real;   // m

// The albedo that the picture shows under the incident light ([P2] eq. 1), of which `indirect` comes from other
// surfaces and the environment; or the remembered one.
vec3 albedo_at(Surfel s, vec3 n, vec3 indirect) {
    vec3 p = s.position_area.xyz, e = indirect;
    if (!camera_sees(p, n)) return unseen_albedo(p);
    for (int i = 0; i < light_count; ++i) {
        vec3 to_light; float radius;
        vec3 e_perp = light_at(listed_light(i), p, n, to_light, radius);
        float cosine = dot(n, to_light);
        if (cosine > 0.0) e += e_perp * cosine * real_visibility(listed_light(i), p, n, bias_real);
    }
    return clamp(PI * measured_radiance(p) / max(e, vec3(1e-6)), ALBEDO_RANGE.x, ALBEDO_RANGE.y);
}
#ifdef BOTH
#define OF_OBJECTS
#endif
#else
#define OF_OBJECTS
#endif

#ifdef OF_OBJECTS
#include "common/materials.glsl"
#ifdef EXTENDED
#include "common/coating.glsl"
#endif

Material virtual_material(Surfel s) {
    return material_of(int(s.normal_material.w), s.uv_voxel.xy, s.tint.rgb, sqrt(s.position_area.w));
}

vec3 virtual_albedo(Surfel s) {
    Material m = virtual_material(s);
    vec3 albedo = mean_diffuse_reflectance(m.diffuse, m.f0, m.roughness) + mean_specular_reflectance(m.f0, m.roughness);
#ifdef EXTENDED
    albedo = mean_coated_reflectance(m, albedo);
#endif
    return min(albedo, vec3(ALBEDO_RANGE.y));
}

vec3 virtual_emission(Surfel s) {
    Material m = virtual_material(s);
#ifdef EXTENDED
    m.emission *= mean_below(m.over);
#endif
    return m.emission;
}
#endif
