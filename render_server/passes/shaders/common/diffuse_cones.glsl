// Irradiance from `cone_count` cosine-stratified cones of equal weight (docs/method.md 4.5).
// Needs march.glsl, environment.glsl.
uniform int cone_count;

// Which cones are traced: every `parts`-th of parts * cone_count directions, starting with number `part`, each
// `width` (0..1) of its own solid angle wide, all rotated by `turn` (rad) about the normal.
struct ConeSet { int parts; int part; float width; float turn; };

// Direction k about z, stratified over the projected solid angle (docs/method.md 4.5).
vec3 cone_direction(int k, ConeSet set) {
    float number = float(set.parts * k + set.part);
    float z = sqrt(1.0 - (number + 0.5) / float(set.parts * cone_count));
    float phi = number * GOLDEN_ANGLE + set.turn;
    return vec3(sqrt(1.0 - z * z) * vec2(cos(phi), sin(phi)), z);
}

// Irradiance without and with the objects, from `q` (voxels) on a surface about n: one-sided voxels do not occlude
// their own surface. `only_rho` skips mu.
void diffuse(vec3 q, vec3 n, ConeSet set, bool only_rho, out vec3 e_mu, out vec3 e_rho) {
    // a solid angle of pi / K: diameter / distance = 2 tan(half-angle)
    float ratio = 1.5 * sqrt(2.0 / float(cone_count));
    float half_angle = atan(0.5 * ratio);
    mat3 basis = basis_around(n);
    e_mu = vec3(0.0);
    e_rho = vec3(0.0);
    for (int k = 0; k < cone_count; ++k) {
        vec3 d = basis * cone_direction(k, set);
        March m = march(q, d, set.width * ratio, only_rho);
        vec3 r = environment(d, half_angle);
        e_mu += m.c_mu + m.t_mu * r;
        e_rho += m.c_rho + m.t_rho * r;
    }
    e_mu *= PI / float(cone_count);
    e_rho *= PI / float(cone_count);
}
