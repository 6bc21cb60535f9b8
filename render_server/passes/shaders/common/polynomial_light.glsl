// What a polynomial texture map gives at a pixel, and what it makes of a lamp. Needs brdf.glsl, shown_maps.glsl.
#include "common/polynomials.glsl"

// `size`: of the pixel's footprint, m.
void take_polynomial(inout Material m, int index, vec2 place_and_turn, vec3 normal, float size) {
    MaterialEntry e = materials[index];
    float row = floor(place_and_turn.x / MAP_STEPS);
    vec2 place = (vec2(place_and_turn.x - MAP_STEPS * row, row) + 0.5) / MAP_STEPS;
    bool mirrored = place_and_turn.y > 0.5 * MIRRORED_TURN;
    float turn = place_and_turn.y - (mirrored ? MIRRORED_TURN : 0.0);
    vec3 n = normalize(normal);
    mat3 basis = basis_around(n);
    m.is_polynomial = true;
    m.rightwards = cos(turn) * basis[0] + sin(turn) * basis[1];
    m.upwards = cross(n, m.rightwards) * (mirrored ? -1.0 : 1.0);
    float level = level_of(e, color_maps, size);
    for (int i = 0; i < 6; ++i) m.polynomial[i] = textureLod(color_maps, vec3(place, e.flags.z - 1.0 + float(i)), level).rgb;
}

// BRDF times cosine for a lamp in direction l.
vec3 polynomial_response(Material m, vec3 l) {
    float u = dot(l, m.rightwards), v = dot(l, m.upwards);
    vec3 sum = m.polynomial[0] + u * m.polynomial[1] + v * m.polynomial[2];
    sum += u * u * m.polynomial[3] + u * v * m.polynomial[4] + v * v * m.polynomial[5];
    vec3 code = clamp(sum, 0.0, 1.0);
    return mix(code / 12.92, pow((code + 0.055) / 1.055, vec3(2.4)), greaterThan(code, vec3(0.04045))) / PI;
}
