// What a texture by the light's direction gives at a pixel, and what it makes of a lamp. Needs brdf.glsl, shown_maps.glsl.
#include "common/textures_by_light.glsl"

void take_polynomial(inout Material m, float turn_and_side, vec3 normal) {
    bool mirrored = turn_and_side > 0.5 * MIRRORED_TURN;
    float turn = turn_and_side - (mirrored ? MIRRORED_TURN : 0.0);
    vec3 n = normalize(normal);
    mat3 basis = basis_around(n);
    m.is_polynomial = true;
    m.rightwards = cos(turn) * basis[0] + sin(turn) * basis[1];
    m.upwards = cross(n, m.rightwards) * (mirrored ? -1.0 : 1.0);
    for (int i = 0; i < 6; ++i)
        m.polynomial[i] = textureLod(color_maps, vec3(m.stack.xy, m.stack.z + float(i)), m.stack.w).rgb;
}

// `packed_uv`: turn and place, as the geometry buffer has them. `size`: of the pixel's footprint, m.
void take_texture(inout Material m, int index, vec2 packed_uv, vec3 normal, float size) {
    MaterialEntry e = materials[index];
    m.stack = vec4(unpack_place(packed_uv.y), e.flags.z - 1.0, level_of(e, color_maps, size));
    m.layers = int(e.flags.w);
    if (m.layers == 0) take_polynomial(m, packed_uv.x, normal);
}

// BRDF times cosine for light from l.
vec3 polynomial_response(Material m, vec3 l) {
    float u = dot(l, m.rightwards), v = dot(l, m.upwards);
    vec3 sum = m.polynomial[0] + u * m.polynomial[1] + v * m.polynomial[2];
    sum += u * u * m.polynomial[3] + u * v * m.polynomial[4] + v * v * m.polynomial[5];
    vec3 code = clamp(sum, 0.0, 1.0);
    return mix(code / 12.92, pow((code + 0.055) / 1.055, vec3(2.4)), greaterThan(code, vec3(0.04045))) / PI;
}

// A stack between its layers, which are the same steps of the cosine apart.
vec3 stack_at(Material m, float cosine, float level) {
    float at = clamp(cosine, 0.0, 1.0) * float(m.layers - 1);
    float low = min(floor(at), float(m.layers - 2));
    vec3 a = textureLod(color_maps, vec3(m.stack.xy, m.stack.z + low), level).rgb;
    vec3 b = textureLod(color_maps, vec3(m.stack.xy, m.stack.z + low + 1.0), level).rgb;
    return mix(a, b, at - low);
}

// The same without what a coat over it reflects.
vec3 base_response(Material m, vec3 l, float cosine) {
    return m.layers > 0 ? stack_at(m, cosine, m.stack.w) / PI : polynomial_response(m, l);
}

// Under a coat, which shines as much as the place is brighter than the stack's mean.
vec3 stack_response(Material m, vec3 n, vec3 v, vec3 l, float cosine, vec2 spread) {
    vec3 shown = stack_at(m, cosine, m.stack.w);
    vec3 mean = stack_at(m, cosine, COARSEST);
    float relief = dot(shown, vec3(1.0)) / max(dot(mean, vec3(1.0)), 1e-4);
    return shown / PI * diffuse_under_lobe(m.f0, m.roughness, cosine, dot(n, v))
        + relief * specular_times_cosine(n, v, l, m.f0, m.roughness, spread);
}
