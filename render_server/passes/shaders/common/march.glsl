// Cone marching through the rho and the mu set (docs/method.md 3, exact operator): outside the support of the delta
// both are equal, and one march is enough.
//
// A ray walks across the slices of cells along its main axis and samples at their faces, half into each, so that
// every cell is counted once, also where the level changes. The coverage met is summed, and a cone is
// blocked when the sum reaches that of a wall. (Front-to-back products of a one-voxel shell let e^-2 of the light
// through at any step size: no furnace test could hold.)
#include "common/volume.glsl"
#include "common/occupancy.glsl"

uniform sampler3D mipmap_mu;
uniform sampler3D mipmap_rho;
uniform sampler3D mipmap_far;   // real scene beyond the volume, coarse, the same in mu and rho
layout(std140) uniform FarVolume {
    vec3 far_origin;   // world position of its low corner, m
    float far_edge;    // of a voxel, m
    int far_size;      // voxels per edge, 0: not used
    int far_levels;
};
layout(std430) readonly buffer OccupiedFar { uint occupied_far[]; };   // as Occupied, of mipmap_far
layout(std430) readonly buffer Support { int support[]; };   // of each volume, voxels where mu and rho differ: min, -max

// A wall's summed coverage scatters about 1 with its slant and position on the grid (2/3..4/3 at 45 degrees) and with
// changes of level and other walls (down to 1/2). Below, the sum is the covered fraction of the cone.
#ifdef MULTIPLIED_COVERAGE
const float PARTLY = 1.0;
const float WALL = 0.97;   // the rest would be invisible in an 8-bit picture
#else
const float PARTLY = 0.4;
const float WALL = 0.5;
#endif

struct March { vec3 c_mu; float t_mu; vec3 c_rho; float t_rho; };

#ifdef KEEPS_COVERAGE
float near_blocked;   // of the last march (of rho), the fraction of the cone that ended in the volume where it began
#endif

struct Crossed { vec3 c; float coverage; };   // radiance gathered, coverage met so far

float blocked_fraction(float coverage) {
    return coverage < PARTLY ? coverage : min(PARTLY + (coverage - PARTLY) * (1.0 - PARTLY) / (WALL - PARTLY), 1.0);
}

void cross_cell(vec4 cell, inout Crossed sum) {
    if (cell.a <= 0.0) return;
#ifdef MULTIPLIED_COVERAGE
    cell *= min(1.0, 1.0 / cell.a) * (1.0 - sum.coverage);   // front to back, as usual
#endif
    float taken = blocked_fraction(sum.coverage + cell.a) - blocked_fraction(sum.coverage);
    sum.c += cell.rgb * (taken / cell.a);
    sum.coverage += cell.a;
}

// A ray through a grid; its coordinate on the main axis is mirrored so that it grows.
struct Walk {
    vec3 from;       // cells of level 0
    float first;     // main coordinate of `from`
    vec3 slope;      // direction, 1 on the main axis
    float stretch;   // distance per cell of the main axis
    vec3 axis;       // unit vector along the main axis
    ivec3 facing;    // slabs that the ray sees from the front
    int end;         // main coordinate of the grid's last face
    int plane;       // that of the face
    int level;
    bool grows;      // whether cells are larger from the next face on
    bool halved;     // whether the sample is of the slice ahead alone, in its middle
    int clear;       // main coordinate of the first face where samples are clear of a surface that the ray starts on
};

#ifdef TWO_SIDED_STARTS
const float OWN_REACH = 2.0;   // voxels in front of a surface where samples still meet it
// Of the surface where marches start: its normal, and whether it has two sides, so that both are in its voxels. A normal of none
// in place of the latter would take registers of its own.
vec3 start_normal = vec3(0.0);
bool starts_two_sided = false;

void start_on(vec3 n, bool two_sided) {
    start_normal = n;
    starts_two_sided = two_sided;
}

void clear_own_surface(inout Walk w) {
    if (starts_two_sided) w.clear = int(ceil(w.first + OWN_REACH / max(dot(start_normal, w.slope), 1e-3)));
}
#else
void clear_own_surface(inout Walk w) {}
#endif

// In a grid of n cells an edge. Nothing behind the start counts.
Walk walk_from(vec3 q, vec3 d, int n) {
    vec3 a = abs(d);
    int main = a.x >= a.y && a.x >= a.z ? 0 : (a.y >= a.z ? 1 : 2);
    float side = d[main] >= 0.0 ? 1.0 : -1.0;
    vec3 axis = vec3(0.0);
    axis[main] = side;
    ivec3 facing = ivec3(d.x >= 0.0 ? 0 : 1, d.y >= 0.0 ? 2 : 3, d.z >= 0.0 ? 4 : 5);
    int plane = int(ceil(side * q[main] - 0.5));
    return Walk(q, side * q[main], d / a[main], 1.0 / a[main], axis, facing, side > 0.0 ? n : 0, plane, 0, false, true, plane);
}

float travelled_to(Walk w, int plane) { return max(float(plane) - w.first, 0.0) * w.stretch; }

float travelled(Walk w) { return travelled_to(w, w.plane); }

vec3 sample_point(Walk w) {
    return w.from + (float(w.plane) - w.first) * w.slope + (w.halved ? 0.5 * float(1 << w.level) : 0.0) * w.axis;
}

float slice_fraction(Walk w) { return w.halved || w.plane == w.end ? 0.5 : 1.0; }

// Whether a sample lies in the grid; at its last face it is of the slice behind.
bool is_within(vec3 at, int n) { return inside_cube(at + 1e-3, float(n) + 2e-3); }

// Cells grow, at most twofold per slice, to half..all of the cone's diameter, at the beginning of a slice that is
// whole on the coarser level too. `before`: distance travelled before this walk, cells of level 0.
bool grows_at(Walk w, int plane, float ratio, float before, int levels) {
    int wide = 2 << w.level;
    bool whole = w.level + 1 < levels && (plane & (wide - 1)) == 0;
    return whole && ratio * (before + travelled_to(w, plane)) >= float(wide);
}

bool grows_next(Walk w, float ratio, float before, int levels) {
    return grows_at(w, w.plane + (1 << w.level), ratio, before, levels);
}

void enlarge_cells(inout Walk w, float ratio, float before, int levels) {
    for (int i = 1; i < levels; ++i) if (grows_at(w, w.plane, ratio, before, levels)) ++w.level;
    w.grows = grows_next(w, ratio, before, levels);
}

// A face where cells grow takes half of the two slices behind it, as one; what is left of them is half of the slice ahead of
// the face before.
void advance(inout Walk w, float ratio, float before, int levels) {
    w.plane += 1 << w.level;
    if (w.grows) ++w.level;
    w.grows = w.halved = grows_next(w, ratio, before, levels);
}

#ifdef ISOTROPIC_VOXELS
// One radiance and one opacity for all directions: the sum of all six, with the opacity of the densest direction.
vec4 directional_sample(sampler3D mipmap, int first, int n, vec3 q, Walk w) {
    vec4 sum = vec4(0.0);
    float most = 0.0;
    for (int k = 0; k < 6; ++k) {
        vec4 cell = volume_sample(mipmap, first, n, q, w.level, k);
        sum += cell;
        most = max(most, cell.a);
    }
    return sum.a > 0.0 ? sum * (most / sum.a) : vec4(0.0);
}
#else
// Coverage and radiance of one slice along the ray. Of all surfaces in a cell, f and b are known: their area towards
// and away from the ray along each axis. The net area n.d is exact; a closed lump adds, on the side that the ray
// sees, at most half of `round` (exact for a sphere) and of the pairs min(f, b) (exact, 0, for a plane: no surface
// occludes itself). Nor does one that has two sides, which is a pair to itself.
vec4 directional_sample(sampler3D mipmap, int first, int n, vec3 q, Walk w) {
    vec4 x = volume_sample(mipmap, first, n, q, w.level, w.facing.x);
    vec4 y = volume_sample(mipmap, first, n, q, w.level, w.facing.y);
    vec4 z = volume_sample(mipmap, first, n, q, w.level, w.facing.z);
    vec3 weights = abs(w.slope);
    vec4 most = weights.x * x + weights.y * y + weights.z * z;
    if (most.a <= 0.0) return vec4(0.0);
    vec3 f = vec3(x.a, y.a, z.a);
    vec3 b = vec3(
        volume_sample(mipmap, first, n, q, w.level, w.facing.x ^ 1).a,
        volume_sample(mipmap, first, n, q, w.level, w.facing.y ^ 1).a,
        volume_sample(mipmap, first, n, q, w.level, w.facing.z ^ 1).a);
    float net = dot(weights, f - b);
    float round = 0.5 * (net + max(abs(net), length(weights * (f + b))));
    float paired = max(net, 0.0) + (w.plane >= w.clear ? length(weights * min(f, b)) : 0.0);
    return most * min(min(round, paired) / most.a, 1.0);
}
#endif

vec4 sample_near(sampler3D mipmap, vec3 q, Walk w) {
    return directional_sample(mipmap, volume * volume_size, volume_size, q, w);
}

// Whether a trilinear sample at q (voxels) may meet anything, of the volume around the objects and of the one beyond.
bool may_be_near(vec3 q, int level) { return is_occupied(volume, volume_size, level, corner_of(q, level)); }
bool may_be_far(vec3 q, int level) {
    ivec3 corner = corner_of(q, level);
    return (occupied_far[corner_word(far_size, level, corner)] >> (corner.x & 31) & 1u) != 0u;
}

// Most cells are empty: the lanes of a processor pass them in a loop of their own, and then sample together. Loops test at
// their end, because software renderers run the body of those that test at their beginning once more, with all lanes masked.

#ifdef ENDS_NEAR
float near_end = ENDLESS;   // voxels: distance at which marches through the volume end

bool in_near(vec3 at, Walk w) { return is_within(at, volume_size) && travelled(w) < near_end; }
#else
bool in_near(vec3 at, Walk w) { return is_within(at, volume_size); }
#endif

// Goes on to the next cell, from that at `at` on, that may hold anything; whether there is one.
bool find_near(inout Walk w, inout vec3 at, float before, float ratio, vec3 low, vec3 high, inout bool differs) {
    bool met = false;
    if (in_near(at, w)) do {
        vec3 reach = vec3(1.5 * float(1 << w.level));
        differs = differs || (all(greaterThan(at, low - reach)) && all(lessThan(at, high + reach)));
        met = may_be_near(at, w.level);
        if (!met) advance(w, ratio, before, volume_levels);
        at = sample_point(w);
    } while (in_near(at, w) && !met);
    return met;
}

// Through the volume around the objects, from q after a distance `before` (both in voxels), until a wall or the volume's end.
// Returns the distance crossed (voxels). `differs`: the path crossed cells where mu and rho differ.
float march_near(
    sampler3D mipmap, vec3 q, vec3 d, float before, float ratio, inout Crossed sum, inout bool differs
) {
    Walk w = walk_from(q, d, volume_size);
    if (before > 0.0) enlarge_cells(w, ratio, before, volume_levels);
    else clear_own_surface(w);
    int held = 6 * volume;
    vec3 low = vec3(support[held], support[held + 1], support[held + 2]);
    vec3 high = vec3(-support[held + 3], -support[held + 4], -support[held + 5]) + 1.0;
    vec3 at = sample_point(w);
    if (find_near(w, at, before, ratio, low, high, differs)) do {
        cross_cell(slice_fraction(w) * sample_near(mipmap, at, w), sum);
        advance(w, ratio, before, volume_levels);
        at = sample_point(w);
    } while (sum.coverage < WALL && find_near(w, at, before, ratio, low, high, differs));
    return travelled(w);
}

#if defined(SEVERAL_VOLUMES) || defined(ENDS_AHEAD)
bool in_far(vec3 at, Walk w, float end) { return is_within(at, far_size) && travelled(w) < end; }
#else
bool in_far(vec3 at, Walk w, float end) { return is_within(at, far_size); }
#endif

// The same in the coarse real scene, until a distance `end` (its voxels).
bool find_far(inout Walk w, inout vec3 at, float before, float end, float ratio) {
    bool met = false;
    if (in_far(at, w, end)) do {
        met = may_be_far(at, w.level);
        if (!met) advance(w, ratio, before, far_levels);
        at = sample_point(w);
    } while (in_far(at, w, end) && !met);
    return met;
}

// Continues through the coarse real scene, from q after a distance `before`, for a distance `end` (all in its voxels) where
// another volume is ahead.
void march_far(vec3 q, vec3 d, float before, float end, float ratio, inout Crossed sum) {
    Walk w = walk_from(q, d, far_size);
    enlarge_cells(w, ratio, before, far_levels);
    vec3 at = sample_point(w);
    if (sum.coverage < WALL && find_far(w, at, before, end, ratio)) do {
        cross_cell(slice_fraction(w) * directional_sample(mipmap_far, 0, far_size, at, w), sum);
        advance(w, ratio, before, far_levels);
        at = sample_point(w);
    } while (sum.coverage < WALL && find_far(w, at, before, end, ratio));
}

// Goes on through the coarse scene where a march from q (voxels of the volume) along d has left the volume after a distance t, `skip`
// (voxels of the coarse scene) farther on.
void march_beyond(vec3 q, vec3 d, float t, float skip, float ratio, inout Crossed sum) {
    if (far_size > 0 && sum.coverage < WALL) {
        vec3 leave = (volume_origin + (q + t * d) * voxel_edge - far_origin) / far_edge;
        march_far(leave + skip * d, d, t * voxel_edge / far_edge + skip, ENDLESS, ratio, sum);
    }
}

// A surface that starts a march outside of the volume must not hit its own coarse voxels.
float own_skip(float t) { return t > 0.0 ? 0.0 : 1.5; }

#ifdef SEVERAL_VOLUMES
// One march from q (voxels) along d, continued through other volumes and, between and behind them, the coarse scene.
Crossed march_one(sampler3D mipmap, vec3 q, vec3 d, float ratio, out bool differs) {
    Crossed sum = Crossed(vec3(0.0), 0.0);
    differs = false;
    int home = volume;
    vec3 from = volume_origin + q * voxel_edge;
    float t = 0.0;   // m
    uint crossed = 0u;
    while (sum.coverage < WALL) {
        float start = crossed == 0u ? 0.0 : t / voxel_edge + 1.0;   // whose first sample lies inside
        crossed |= 1u << volume;
        t = voxel_edge * (start + march_near(mipmap, volume_coordinate(from) + start * d, d, start, ratio, sum, differs));
#ifdef KEEPS_COVERAGE
        if (start == 0.0) near_blocked = blocked_fraction(sum.coverage);
#endif
        float skip = own_skip(t), next = t > 0.0 ? enter_next(from, d, t, crossed) : ENDLESS;
        vec3 leave = (from + t * d - far_origin) / far_edge + skip * d;
        if (far_size > 0 && sum.coverage < WALL) march_far(leave, d, t / far_edge + skip, (next - t) / far_edge, ratio, sum);
        if (next == ENDLESS) break;
        t = next;
    }
    volume = home;
    return sum;
}

// What both marches meet; mu's is rho's where the way does not differ.
void march_both(vec3 q, vec3 d, float ratio, bool only_rho, out Crossed mu, out Crossed rho) {
    bool differs;
    mu = rho = march_one(mipmap_rho, q, d, ratio, differs);
    if (differs && !only_rho) mu = march_one(mipmap_mu, q, d, ratio, differs);
}
#else
// One march from q (voxels) along d, continued into the coarse scene.
Crossed march_one(sampler3D mipmap, vec3 q, vec3 d, float ratio, out bool differs) {
    Crossed sum = Crossed(vec3(0.0), 0.0);
    differs = false;
    float t = march_near(mipmap, q, d, 0.0, ratio, sum, differs);
    march_beyond(q, d, t, own_skip(t), ratio, sum);
    return sum;
}

// What both marches meet; mu's is rho's where the way does not differ. Beyond the volume both run the same code, in turn: drivers
// compile every call anew.
void march_both(vec3 q, vec3 d, float ratio, bool only_rho, out Crossed mu, out Crossed rho) {
    bool differs = false, ignored = false;
    rho = mu = Crossed(vec3(0.0), 0.0);
    float t_rho = march_near(mipmap_rho, q, d, 0.0, ratio, rho, differs), t_mu = t_rho;
#ifdef KEEPS_COVERAGE
    near_blocked = blocked_fraction(rho.coverage);
#endif
    differs = differs && !only_rho;
    if (differs) t_mu = march_near(mipmap_mu, q, d, 0.0, ratio, mu, ignored);
    bool is_mu = false, goes_on;
    do {
        Crossed sum = is_mu ? mu : rho;
        float t = is_mu ? t_mu : t_rho;
        march_beyond(q, d, t, own_skip(t), ratio, sum);
        if (is_mu || !differs) mu = sum;
        if (!is_mu) rho = sum;
        goes_on = differs && !is_mu;
        is_mu = true;
    } while (goes_on);
}
#endif

// Both marches from q (voxels) along d; `ratio` = cone diameter / distance. With `only_rho`, mu is that of rho.
March march(vec3 q, vec3 d, float ratio, bool only_rho) {
    Crossed mu, rho;
    march_both(q, d, ratio, only_rho, mu, rho);
    return March(mu.c, 1.0 - blocked_fraction(mu.coverage), rho.c, 1.0 - blocked_fraction(rho.coverage));
}
