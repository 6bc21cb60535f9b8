// What a virtual object's surface makes of light that was gathered for it (docs/method.md 4.7). Needs brdf.glsl.
#include "common/materials.glsl"

struct Indirect { vec3 irradiance; vec3 specular; };   // specular: mean radiance over the lobe

// The radiance that the surface sends already, and what it reflects of the gathered light.
vec3 with_gathered(vec3 radiance, Material m, float n_dot_v, Indirect indirect) {
    vec3 reflectance = specular_reflectance(m.f0, m.roughness, n_dot_v);
#ifdef MATERIAL_MAPS
    indirect.irradiance *= m.occlusion;
    indirect.specular *= m.occlusion;
#endif
    return radiance + m.diffuse / PI * (1.0 - reflectance) * indirect.irradiance + reflectance * indirect.specular;
}
