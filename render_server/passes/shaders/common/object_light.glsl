// Radiance of a virtual object's surface towards v (docs/method.md 4.7). Needs lights.glsl and brdf.glsl.
#include "common/gathered_light.glsl"

uniform float noise_sigma;      // m at 1 m
uniform float beam_alpha;       // of the roughest transparent objects through which beams bring light; 0: none do
uniform float normal_offset;    // m: against self-shadowing by the virtual depth map

vec3 direct_radiance(vec3 p, float depth, vec3 n, vec3 v, Material m) {
    vec3 sum = vec3(0.0);
    for (int i = 0; i < light_count; ++i) {
        vec3 l; float radius;
        vec3 across = light_at(lights[i], p, n, l, radius);
        float cosine = dot(n, l);
        if (cosine <= 0.0) continue;
        vec3 lifted = p + normal_offset * n;
        vec2 fraction = visibility(lights[i], lifted, n, 3.0 * noise_sigma * depth * depth, 0.0);
        vec3 seen = arriving(lights[i], lifted, fraction, beam_alpha);
        vec3 base = m.diffuse / PI * diffuse_under_lobe(m.f0, m.roughness, cosine, dot(n, v));
        vec3 response = base * cosine + specular_times_cosine(n, v, l, m.f0, m.roughness, radius);
        sum += across * seen * response;
    }
    return sum;
}

vec3 object_radiance(vec3 p, float depth, vec3 n, vec3 v, Material m, Indirect indirect) {
    return with_gathered(m.emission + direct_radiance(p, depth, n, v, m), m, max(dot(n, v), 1e-3), indirect);
}
