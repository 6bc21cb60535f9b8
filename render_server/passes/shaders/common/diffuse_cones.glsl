// Irradiance from `cone_count` cosine-stratified cones of equal weight (docs/method.md 4.5).
// Needs march.glsl, environment.glsl.
uniform int cone_count;

// Which cones are traced: every `parts`-th of parts * cone_count directions, starting with number `part`, each
// `width` (0..1) of its own solid angle wide, all rotated by `turn` (rad) about the normal.
struct ConeSet { int parts; int part; float width; float turn; };

// Four adjacent texels share four times as many directions, each cone half as wide as its own solid angle;
// bilateral_cone_filter takes the mean.
ConeSet cones_of(ivec2 texel) { return ConeSet(4, (texel.x & 1) + 2 * (texel.y & 1), 0.5, 0.0); }

// Direction k about z, stratified over the projected solid angle (docs/method.md 4.5).
vec3 cone_direction(int k, ConeSet set) {
    float number = float(set.parts * k + set.part);
    float z = sqrt(1.0 - (number + 0.5) / float(set.parts * cone_count));
    float phi = number * GOLDEN_ANGLE + set.turn;
    return vec3(sqrt(1.0 - z * z) * vec2(cos(phi), sin(phi)), z);
}

float cone_ratio() { return 1.5 * sqrt(2.0 / float(cone_count)); }   // diameter / distance of a solid angle of pi / K

// Whether a cone from q may cross cells where mu and rho differ: those within 1.5 cells of the support, whose size follows the
// cone's (march.glsl). `ball`: around the support.
bool may_differ(vec3 q, vec3 d, float ratio, vec4 ball) {
    float along = dot(ball.xyz - q, d), slope = 1.5 * ratio, across = length(ball.xyz - q - along * d);
    if (slope >= 1.0) return true;
    // Least of sqrt(across^2 + (t - along)^2) - slope t over t >= 0.
    float t = max(along + across * slope * inversesqrt(1.0 - slope * slope), 0.0);
    return length(vec2(across, t - along)) - slope * t <= ball.w;
}

vec4 ball_around_support() {
    int held = 6 * volume;
    vec3 low = vec3(support[held], support[held + 1], support[held + 2]);
    vec3 high = vec3(-support[held + 3], -support[held + 4], -support[held + 5]) + 1.0;
    return vec4(0.5 * (low + high), 0.5 * length(high - low) + 3.0);   // the first samples lie a cell off the axis
}

// Whether a cone from q may meet a change in any volume. `ball`: of this one.
bool may_meet_change(vec3 q, vec3 d, float ratio, vec4 ball) {
    bool meets = may_differ(q, d, ratio, ball);
#ifdef SEVERAL_VOLUMES
    int home = volume;
    vec3 from = volume_origin + q * voxel_edge;
    for (volume = 0; volume < volume_count; ++volume)
        meets = meets || may_differ(volume_coordinate(from), d, ratio, ball_around_support());
    volume = home;
#endif
    return meets;
}

// Change of the irradiance by the objects. Lanes of a processor walk through their own lists of cones that meet any.
vec3 diffuse_change(vec3 q, vec3 n, ConeSet set) {
    float ratio = set.width * cone_ratio(), half_angle = atan(0.5 * cone_ratio());
    vec4 ball = ball_around_support();
    mat3 basis = basis_around(n);
    vec3 change = vec3(0.0);
    for (int first = 0; first < cone_count; first += 32) {
        uint met = 0u;
        for (int k = first; k < min(first + 32, cone_count); ++k)
            if (may_meet_change(q, basis * cone_direction(k, set), ratio, ball)) met |= 1u << (k - first);
        if (met != 0u) do {
            int k = findLSB(met);
            met &= met - 1u;
            vec3 d = basis * cone_direction(first + k, set);
            March m = march(q, d, ratio, false);
            change += m.c_rho - m.c_mu + (m.t_rho - m.t_mu) * environment(d, half_angle);
        } while (met != 0u);
    }
    return change * PI / float(cone_count);
}

#ifdef KEEPS_COVERAGE
float near_coverage;   // of `diffuse`: fraction of the hemisphere, by cosine, where surfaces of the volume are
#endif

// A cone of what a surface reflects, and its weight.
struct Lobe { vec3 axis; float half_angle; float ratio; vec3 weight; };

Lobe lobe_along(vec3 axis, float half_angle, vec3 weight) { return Lobe(axis, half_angle, 2.0 * tan(half_angle), weight); }

// Light without and with the objects: irradiance, and the lobes' weighted mean radiance.
struct Gathered { vec3 e_mu; vec3 e_rho; vec3 lobe_mu; vec3 lobe_rho; };

// By the diffuse cones from number `first` on, and by as many `lobes`, from `q` (voxels) on a surface about n: one-sided voxels do not
// occlude their own surface. `only_rho` skips mu. One loop for all cones: drivers compile every call of a march anew.
Gathered gather_cones(vec3 q, vec3 n, ConeSet set, bool only_rho, int first, int lobes, Lobe base, Lobe coat) {
    float ratio = set.width * cone_ratio(), half_angle = atan(0.5 * cone_ratio());
    mat3 basis = basis_around(n);
    Gathered sum = Gathered(vec3(0.0), vec3(0.0), vec3(0.0), vec3(0.0));
#ifdef KEEPS_COVERAGE
    near_coverage = 0.0;
#endif
    int k = first, end = cone_count + lobes;
    if (k < end) do {   // a loop that tests at its end: march.glsl
        bool is_lobe = lobes > 0 && k >= cone_count;
        Lobe lobe = k == cone_count ? base : coat;
        vec3 d = is_lobe ? lobe.axis : basis * cone_direction(k, set);
        March m = march(q, d, is_lobe ? lobe.ratio : ratio, only_rho);
        vec3 r = environment(d, is_lobe ? lobe.half_angle : half_angle);
        vec3 mu = m.c_mu + m.t_mu * r, rho = m.c_rho + m.t_rho * r;
        sum.e_mu += is_lobe ? vec3(0.0) : mu;
        sum.e_rho += is_lobe ? vec3(0.0) : rho;
        sum.lobe_mu += is_lobe ? lobe.weight * mu : vec3(0.0);
        sum.lobe_rho += is_lobe ? lobe.weight * rho : vec3(0.0);
#ifdef KEEPS_COVERAGE
        near_coverage += is_lobe ? 0.0 : near_blocked / float(cone_count);
#endif
    } while (++k < end);
    sum.e_mu *= PI / float(cone_count);
    sum.e_rho *= PI / float(cone_count);
    return sum;
}

// Irradiance alone.
void diffuse(vec3 q, vec3 n, ConeSet set, bool only_rho, out vec3 e_mu, out vec3 e_rho) {
    Lobe none = Lobe(n, 0.0, 0.0, vec3(0.0));
    Gathered found = gather_cones(q, n, set, only_rho, 0, 0, none, none);
    e_mu = found.e_mu;
    e_rho = found.e_rho;
}
