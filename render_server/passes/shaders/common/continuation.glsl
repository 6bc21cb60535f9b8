uniform float sample_distance;   // m at 1 m depth: size of a texel of the reduced grid

// Weight by how well the point (sp, sn) continues the plane (p, n); `size`: scale of deviations, m.
float continuation(vec3 p, vec3 n, vec3 sp, vec3 sn, float size) {
    float off = abs(dot(sp - p, n)) / size;
    float turn = max(0.0, dot(n, sn));
    return exp(-off * off) * turn * turn * turn * turn;
}
