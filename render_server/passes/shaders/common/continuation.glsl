// How well the plane (p, n) holds the point (sp, sn); `size`: distance at which a deviation counts, m.
float continuation(vec3 p, vec3 n, vec3 sp, vec3 sn, float size) {
    float off = abs(dot(sp - p, n)) / size;
    float turn = max(0.0, dot(n, sn));
    return exp(-off * off) * turn * turn * turn * turn;
}
