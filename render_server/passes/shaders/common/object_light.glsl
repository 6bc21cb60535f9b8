// Radiance of a virtual object's surface towards v (docs/method.md 4.7). Needs lights.glsl and brdf.glsl.
#include "common/materials.glsl"

uniform float noise_sigma;      // m at 1 m
uniform float normal_offset;    // m: against self-shadowing by the virtual depth map

struct Indirect { vec3 irradiance; vec3 specular; };

vec3 direct_radiance(vec3 p, float depth, vec3 n, vec3 v, Material m) {
    vec3 sum = vec3(0.0);
    for (int i = 0; i < light_count; ++i) {
        vec3 l; float radius;
        vec3 across = light_at(lights[i], p, n, l, radius);
        float cosine = dot(n, l);
        if (cosine <= 0.0) continue;
        float seen = visibility(lights[i], p + normal_offset * n, n, 3.0 * noise_sigma * depth * depth, 0.0).y;
        vec3 base = m.diffuse / PI * diffuse_under_lobe(m.f0, m.roughness, cosine, dot(n, v));
        vec3 response = base * cosine + specular_times_cosine(n, v, l, m.f0, m.roughness, radius);
        sum += across * seen * response;
    }
    return sum;
}

vec3 object_radiance(vec3 p, float depth, vec3 n, vec3 v, Material m, Indirect indirect) {
    float n_dot_v = max(dot(n, v), 1e-3);
    vec3 reflectance = specular_reflectance(m.f0, m.roughness, n_dot_v);
#ifdef MATERIAL_MAPS
    indirect.irradiance *= m.occlusion;
    indirect.specular *= m.occlusion;
#endif
    return m.emission + direct_radiance(p, depth, n, v, m)
        + m.diffuse / PI * (1.0 - reflectance) * indirect.irradiance + reflectance * indirect.specular;
}
