// Radiance of a virtual object's surface towards v (docs/method.md 4.7). Needs lights.glsl and brdf.glsl.
#include "common/gathered_light.glsl"

#ifdef MEASURED
#ifdef MATERIAL_MAPS
#include "common/texture_response.glsl"
#endif
#endif

uniform float noise_sigma;      // m at 1 m
uniform float beam_alpha;       // of the roughest transparent objects through which beams bring light; 0: none do
uniform float normal_offset;    // m: against self-shadowing by the objects' map

// BRDF times cosine; `spread` as in specular_times_cosine.
vec3 response_times_cosine(vec3 n, vec3 v, vec3 l, float cosine, Material m, vec2 spread) {
#ifdef MEASURED
    if (m.measured >= 0) return measured_times_cosine(m.measured, n, v, l, length(vec2(spread.x, 2.0 * spread.y)));
#ifdef MATERIAL_MAPS
    if (m.layers > 0) return stack_response(m, n, v, l, cosine, spread);
    if (m.is_polynomial) return polynomial_response(m, l);
#endif
#endif
#ifdef EXTENDED
    return coated_response(m, n, v, l, cosine, spread);
#else
    vec3 base = m.diffuse / PI * diffuse_under_lobe(m.f0, m.roughness, cosine, dot(n, v));
    return base * cosine + specular_times_cosine(n, v, l, m.f0, m.roughness, spread);
#endif
}

// `turn`: half-angle (rad) of a disc over which curvature turns the normal within the pixel.
vec3 direct_radiance(vec3 p, float depth, vec3 n, vec3 v, Material m, float turn) {
    vec3 sum = vec3(0.0);
    int i = 0;
    if (light_count > 0) do {   // a loop that tests at its end: lights.glsl
        vec3 l; float radius;
        vec3 e_perp = light_at(listed_light(i), p, n, l, radius);
        float cosine = dot(n, l);
        if (cosine <= 0.0) continue;
        vec3 lifted = p + normal_offset * n;
        vec2 fraction = visibility(listed_light(i), lifted, n, 3.0 * noise_sigma * depth * depth, 0.0);
        vec3 seen = arriving(listed_light(i), lifted, fraction, beam_alpha);
        sum += e_perp * seen * response_times_cosine(n, v, l, cosine, m, vec2(radius, turn));
    } while (++i < light_count);
    return sum;
}

vec3 object_radiance(vec3 p, float depth, vec3 n, vec3 v, Material m, Indirect indirect, float turn) {
    return with_gathered(emitted(m, n, v) + direct_radiance(p, depth, n, v, m, turn), m, n, v, indirect);
}
