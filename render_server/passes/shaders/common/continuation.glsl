uniform float sample_distance;   // m at 1 m depth: size of a texel of the reduced grid

// Weight by how well the point (sp, sn) continues the plane (p, n); `size`: scale of deviations, m.
float continuation(vec3 p, vec3 n, vec3 sp, vec3 sn, float size) {
    float off = abs(dot(sp - p, n)) / size;
    float turn = max(0.0, dot(n, sn));
    return exp(-off * off) * turn * turn * turn * turn;
}

// Some texels of the reduced grid on a surface as seen from `away` (unit), m: what reaches so far may reach a neighbour.
float grid_margin(float depth, vec3 n, vec3 away) { return 2.0 * sample_distance * depth / max(dot(n, away), 0.1); }
