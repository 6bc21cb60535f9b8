// Soft shadows of the lights' depth maps, by a search for blockers and then samples of the light's area, bilinearly
// compared (percentage-closer soft shadows, Fernando 2005; docs/method.md 3.1).
#include "common/basis.glsl"
#include "common/light_shapes.glsl"
#include "common/light_views.glsl"

uniform sampler2D real_rsm_depth;
uniform sampler2D object_rsm_depth;
uniform int shadow_samples;

const float WIDE_TEXELS = 6.0;   // penumbrae wider than this get more samples

// A receiver in a light's view: its plane, so that a tilted surface does not block its own surroundings.
struct Receiver { vec2 s; float depth; vec3 normal; float plane; float bias; };

const float DEPTH_ROUNDING = 1e-4;   // relative: prevents self-occlusion by rounding of a surface's own depth

Receiver receiver_at(LightView view, vec3 p, vec3 n, float bias) {
    vec3 v = (view.view_from_world * vec4(p, 1.0)).xyz;
    vec3 normal = mat3(view.view_from_world) * n;
    normal.z = min(normal.z, -0.1);   // grazing: a slope of at most 10
    return Receiver(lateral(view, v), v.z, normal, dot(normal, v), bias + DEPTH_ROUNDING * abs(v.z));
}

// Depth of the receiver's plane at another lateral position.
float plane_depth(LightView view, Receiver r, vec2 s) {
    float z = view.range.z > 0.5 ? (r.plane - dot(r.normal.xy, s)) / r.normal.z
                                 : r.plane / min(dot(r.normal.xy, s) + r.normal.z, -1e-3);
    return z > 0.0 ? z : r.depth;
}

// Bilinear comparison: fraction of the 2x2 texels around s that are no nearer to the light than `depth`.
float lit_fraction(sampler2D map, LightView view, vec2 s, float depth) {
    vec2 t = tile_texel(view, s);
    if (t.x < 0.0) return 1.0;
    t = clamp(t, view.tile.xy + 0.5, view.tile.xy + view.tile.z - 0.5);
    vec2 first = floor(t - 0.5);
    vec4 d = textureGather(map, (first + 1.0) / vec2(textureSize(map, 0)), 0);   // (0,1) (1,1) (1,0) (0,0)
    vec4 lit = vec4(greaterThanEqual(d, vec4(min(depth <= view.range.x ? 0.0 : map_depth(view, depth), 1.0))));
    vec2 f = t - 0.5 - first;
    return mix(mix(lit.w, lit.z, f.x), mix(lit.x, lit.y, f.x), f.y);
}

// A light's area as seen by a receiver on the map. At a blocker's depth the ray from the sample at offset o (on the
// unit disc, or in the square -1..1 of a rectangle) is shifted laterally by gap (u o.x + v o.y) / (1 - dot(lean, o)).
struct LightExtent { vec2 u; vec2 v; vec2 lean; float widest; bool square; };

const float STEEPEST_LEAN = 0.9;   // samples as deep in the view as the receiver count as this deep

LightExtent light_extent(Light light, LightView view, vec2 s, float depth) {
    float size = light.shape.x;
    LightExtent k = LightExtent(vec2(size, 0.0), vec2(0.0, size), vec2(0.0), size, is_rectangle(light));
    if (k.square) {
        vec3 u = mat3(view.view_from_world) * light.axis_u.xyz, v = mat3(view.view_from_world) * light.axis_v.xyz;
        k.u = u.xy - s * u.z;
        k.v = v.xy - s * v.z;
        k.lean = vec2(u.z, v.z) / depth;
        float most = abs(k.lean.x) + abs(k.lean.y);
        k.lean *= min(1.0, STEEPEST_LEAN / max(most, 1e-6));
        vec2 extent = abs(k.u) + abs(k.v);
        k.widest = max(extent.x, extent.y) / (1.0 - min(most, STEEPEST_LEAN));
    }
    return k;
}

// Lateral drift of a ray between a blocker and the receiver, per unit of the light's area.
float drift(LightView view, float receiver, float blocker) {
    return view.range.z > 0.5 ? max(receiver - blocker, 0.0) : max(1.0 / blocker - 1.0 / receiver, 0.0);
}

vec2 lateral_shift(LightExtent k, float gap, vec2 o) {
    return k.square ? gap * (k.u * o.x + k.v * o.y) / (1.0 - dot(k.lean, o)) : gap * k.widest * o;
}

float square_norm(vec2 o) { return max(abs(o.x), abs(o.y)); }

float cross2(vec2 a, vec2 b) { return a.x * b.y - a.y * b.x; }

// Whether a shift, reduced by `margin`, is within the light's area (shift_to solved for o by Cramer's rule,
// undivided).
bool within_rectangle(LightExtent k, float gap, vec2 shift, float margin) {
    shift *= max(1.0 - margin / max(length(shift), 1e-12), 0.0);
    vec2 q = vec2(cross2(shift, k.v), cross2(k.u, shift));
    return square_norm(q) <= abs(gap * cross2(k.u, k.v) + dot(k.lean, q));
}

// Sample j of the light's area: a spiral on the unit disc, a Fibonacci lattice on the square.
vec2 light_sample(LightExtent k, int j, int count) {
    float along = (float(j) + 0.5) / float(count);
    float phi = float(j) * GOLDEN_ANGLE;
    return k.square ? 2.0 * vec2(along, fract(phi / (2.0 * PI))) - 1.0 : sqrt(along) * vec2(cos(phi), sin(phi));
}

// Every loop over a light's samples appears twice, once for discs and once for squares, with no iterations for the
// other kind: llvmpipe leaves a loop early, but executes both sides of a branch. Loops test at their end, because it runs
// the body of those that test at their beginning once more, with all lanes masked.

struct Blocking { float sum; float hits; float deepest; };   // depths

void add_blocker(float d, inout Blocking found) {
    found = Blocking(found.sum + d, found.hits + 1.0, max(found.deepest, d));
}

// Of a disc. What lies within the light's area at a shift is nearer the light by an amount that grows with the shift: in the map's own
// depth, below a limit that falls linearly. Each sample is the one before, turned and moved outwards.
void add_disc_blockers(sampler2D map, LightExtent k, LightView view, Receiver r, int count, inout Blocking found) {
    float near = view.range.x, far = view.range.y, texels = 0.5 * view.tile.z / view.tile.w;
    float widest = count == 1 ? 0.0 : k.widest * drift(view, r.depth, near);
    float slope = (view.range.z > 0.5 ? 1.0 : near * far) / ((far - near) * max(k.widest, 1e-12));
    float nearer = min(map_depth(view, r.depth - r.bias), 1.0);
    float limit = map_depth(view, r.depth) + slope * 0.5 / texels;   // a shift counts beyond half a texel
    vec2 low = view.tile.xy, high = low + view.tile.z, centre = low + 0.5 * view.tile.z + texels * r.s;
    vec2 turn = vec2(cos(GOLDEN_ANGLE), sin(GOLDEN_ANGLE)), direction = vec2(1.0, 0.0);
    float spacing = widest / float(count), shift = 0.5 * spacing;
    int j = 0;
    if (count > 0) do {
        vec2 t = centre + texels * shift * direction;
        float d = texelFetch(map, ivec2(t), 0).r;
        bool in_tile = all(greaterThanEqual(t, low)) && all(lessThan(t, high));
        if (in_tile && d < min(nearer, limit - slope * shift)) add_blocker(linear_depth(view, d), found);
        direction = vec2(direction.x * turn.x - direction.y * turn.y, direction.x * turn.y + direction.y * turn.x);
        shift += spacing;
    } while (++j < count);
}

void add_square_blockers(sampler2D map, LightExtent k, LightView view, Receiver r, int count, inout Blocking found) {
    k.square = true;
    float gap = drift(view, r.depth, view.range.x);
    float margin = view.tile.w / view.tile.z;   // half a texel
    int j = 0;
    if (count > 0) do {
        vec2 unit = light_sample(k, j, count);
        vec2 offset = count == 1 ? vec2(0.0) : lateral_shift(k, gap, square_norm(unit) * unit);
        vec2 t = tile_texel(view, r.s + offset);
        if (t.x < 0.0) continue;
        float d = first_depth(map, view, ivec2(t));
        if (d < r.depth - r.bias && within_rectangle(k, drift(view, r.depth, d), offset, margin)) add_blocker(d, found);
    } while (++j < count);
}

// Mean and greatest depth of the blockers of the light's area in one map; NOTHING if there are none. Only blockers
// inside the cone from the receiver to that area count, so that a tilted or noisy surface does not block itself.
// Samples are denser near the axis, because blockers near the receiver matter only there.
vec2 find_blockers(sampler2D map, LightExtent k, LightView view, Receiver r) {
    float widest = k.widest * drift(view, r.depth, view.range.x);
    float texel = 2.0 * view.tile.w / view.tile.z;
    int count = widest < 0.5 * texel ? 1   // below half a texel: one sample
        : widest > WIDE_TEXELS * texel ? 2 * shadow_samples : shadow_samples;
    Blocking found = Blocking(0.0, 0.0, 0.0);
    add_disc_blockers(map, k, view, r, k.square ? 0 : count, found);
    if (has_rectangles) add_square_blockers(map, k, view, r, k.square ? count : 0, found);
    if (found.hits == 0.0) return vec2(lit_fraction(map, view, r.s, r.depth - r.bias) < 1.0 ? r.depth : NOTHING);
    return vec2(found.sum / found.hits, found.deepest);
}

const float STEEPEST = 3.0;   // limit of the slope that a texel's rise is corrected for

// `blocker`: mean and greatest depth; `gap`: the drift from there.
struct Occluder { bool present; LightView view; Receiver receiver; LightExtent extent; vec2 blocker; vec2 gap; };

Occluder occluder(sampler2D map, Light light, int first, int count, vec3 p, vec3 n, float bias) {
    Occluder o;
    o.present = false;
    if (count == 0) return o;
    o.view = listed_view(view_containing(first, count, p));
    o.receiver = receiver_at(o.view, p, n, bias);
    // The rise of a tilted surface within a texel of the map must not block it either.
    float texel = 2.0 * o.view.tile.w / o.view.tile.z * (o.view.range.z > 0.5 ? 1.0 : o.receiver.depth);
    float slope = (abs(o.receiver.normal.x) + abs(o.receiver.normal.y)) / -o.receiver.normal.z;   // for diagonal texels too
    o.receiver.bias += texel * min(slope, STEEPEST);
    if (o.receiver.depth - o.receiver.bias <= o.view.range.x) return o;
    o.extent = light_extent(light, o.view, o.receiver.s, o.receiver.depth);
    float reach = o.extent.widest * drift(o.view, o.receiver.depth, o.view.range.x);
    if (any(greaterThan(abs(o.receiver.s), vec2(o.view.tile.w + reach)))) return o;
    o.blocker = find_blockers(map, o.extent, o.view, o.receiver);
    o.present = o.blocker.x < NOTHING;
    for (int i = 0; i < 2; ++i) o.gap[i] = o.present ? drift(o.view, o.receiver.depth, o.blocker[i]) : 0.0;
    return o;
}

// Whether the ray to one sample of the light is unblocked, bilinearly: at the mean blocker's depth, and for a
// rectangle at the deepest one's too, because blockers near a large light are seldom flat. The receiver's plane may
// rise towards the light there, but things a quarter of the distance to the blockers above it do block.
float sample_visibility(sampler2D map, Occluder o, vec2 offset) {
    float lit = 1.0;
    for (int i = 0; i < (has_rectangles && o.extent.square ? 2 : 1); ++i) {
        vec2 s = o.receiver.s + lateral_shift(o.extent, o.gap[i], offset);
        float highest = mix(o.receiver.depth, o.blocker[i], 0.75);
        float depth = clamp(plane_depth(o.view, o.receiver, s), highest, o.receiver.depth);
        lit = min(lit, lit_fraction(map, o.view, s, depth - o.receiver.bias));
    }
    return lit;
}

// If the penumbra is many texels wide, few samples would show as steps.
int samples_for(Occluder o) {
    if (!o.present) return 1;
    float texels = o.extent.widest * o.gap.x * o.view.tile.z / (2.0 * o.view.tile.w);
    return texels > WIDE_TEXELS ? 4 * shadow_samples : shadow_samples;
}

// Weight of sample o of a rectangle in the irradiance, up to a factor; 1 for other lights, whose samples are equal.
float sample_weight(Light light, LightExtent k, vec3 p, vec3 n, vec2 o) {
    vec3 d = light.place.xyz + mat2x3(light.axis_u.xyz, light.axis_v.xyz) * o - p;
    float cosines = max(dot(d, n), 0.0) * max(-dot(d, cross(light.axis_u.xyz, light.axis_v.xyz)), 0.0);
    return k.square ? cosines / max(dot(d, d) * dot(d, d), 1e-12) : 1.0;
}

// Adds (v_mu, v_rho, 1) times its weight for each sample of the light's area.
void add_samples(
    bool square, Light light, LightExtent k, Occluder real, Occluder object, vec3 p, vec3 n, int count, inout vec3 sum
) {
    k.square = real.extent.square = object.extent.square = square;
    int j = 0;
    if (count > 0) do {
        vec2 offset = light_sample(k, j, count);
        float w = sample_weight(light, k, p, n, offset);
        float v = real.present ? sample_visibility(real_rsm_depth, real, offset) : 1.0;
        sum.xz += w * vec2(v, 1.0);
        if (object.present && v > 0.0) v *= sample_visibility(object_rsm_depth, object, offset);
        sum.y += w * v;
    } while (++j < count);
}

vec2 visible_fraction(Light light, Occluder real, Occluder object, vec3 p, vec3 n) {
    if (!real.present && !object.present) return vec2(1.0);
    int count = max(samples_for(real), samples_for(object));
    LightExtent k = real.present ? real.extent : object.extent;
    vec3 sum = vec3(0.0);
    add_samples(false, light, k, real, object, p, n, k.square ? 0 : count, sum);
    if (has_rectangles) add_samples(true, light, k, real, object, p, n, k.square ? count : 0, sum);
    return sum.z > 0.0 ? sum.xy / sum.z : vec2(1.0);
}
