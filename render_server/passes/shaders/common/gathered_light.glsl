// What a virtual object's surface makes of light that was gathered for it (docs/method.md 4.7). Needs brdf.glsl.
#include "common/materials.glsl"
#pragma switch MEASURED
#ifdef MEASURED
#include "common/measured.glsl"
#endif

struct Indirect { vec3 irradiance; vec3 specular; };   // specular: mean radiance over the lobe

// The radiance that the surface sends already, and what it reflects of the gathered light.
vec3 with_gathered(vec3 radiance, Material m, float n_dot_v, Indirect indirect) {
#ifdef MEASURED
    if (m.measured >= 0)
        return radiance + measured_base(m.measured).rgb / PI * indirect.irradiance
            + lobes_albedo(m.measured, n_dot_v) * indirect.specular;
#endif
    vec3 reflectance = specular_reflectance(m.f0, m.roughness, n_dot_v);
#ifdef MATERIAL_MAPS
    indirect.irradiance *= m.occlusion;
    indirect.specular *= m.occlusion;
#endif
    return radiance + m.diffuse / PI * (1.0 - reflectance) * indirect.irradiance + reflectance * indirect.specular;
}
