// What a virtual object's surface makes of light that was gathered for it (docs/method.md 4.7). Needs brdf.glsl.
#include "common/materials.glsl"
#ifdef EXTENDED
#include "common/coating.glsl"
#endif
#pragma switch MEASURED
#ifdef MEASURED
#include "common/measured.glsl"
#endif

struct Indirect { vec3 irradiance; vec3 specular; };   // specular: mean radiance over the lobe, or over that and its coat's

// The radiance that the surface sends already, and what it reflects of the gathered light towards v.
vec3 with_gathered(vec3 radiance, Material m, vec3 n, vec3 v, Indirect indirect) {
    float n_dot_v = max(dot(n, v), 1e-3);
#ifdef MEASURED
    if (m.measured >= 0)
        return radiance + measured_base(m.measured).rgb / PI * indirect.irradiance
            + lobes_albedo(m.measured, n_dot_v) * indirect.specular;
#endif
#ifdef MATERIAL_MAPS
    indirect.irradiance *= m.occlusion;
    indirect.specular *= m.occlusion;
#endif
#ifdef EXTENDED
    Reflected r = reflected_towards(m, n, v);
    vec3 matt = r.sheen + m.diffuse * (r.below - r.lobe);
    return radiance + matt / PI * indirect.irradiance + (r.coat + r.lobe) * indirect.specular;
#else
    vec3 reflectance = specular_reflectance(m.f0, m.roughness, n_dot_v);
    return radiance + m.diffuse / PI * (1.0 - reflectance) * indirect.irradiance + reflectance * indirect.specular;
#endif
}

// What a surface sends of its own towards v.
vec3 emitted(Material m, vec3 n, vec3 v) {
#ifdef EXTENDED
    return reflected_towards(m, n, v).below * m.emission;
#else
    return m.emission;
#endif
}
