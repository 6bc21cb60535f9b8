// Lights, their depth maps, and soft visibility with and without the virtual objects (docs/method.md 3, direct).
#include "common/basis.glsl"
#include "common/brdf.glsl"
#include "common/light_shapes.glsl"

struct LightView {
    mat4 view_from_world;   // light at the origin (unless directional), looking along +z
    vec4 tile;              // x, y, size in texels; half extent (m for directional, else tangent)
    vec4 range;             // near, far in m; 1 if orthographic; 0
    vec4 front;             // plane (world) in front of which the light shines
};

// A row each, as those of lights.
layout(rgba32ui) readonly uniform uimage2D light_view_rows;

vec4 view_column(int i, int column) { return uintBitsToFloat(imageLoad(light_view_rows, ivec2(column, i))); }

LightView listed_view(int i) {
    mat4 view_from_world = mat4(view_column(i, 0), view_column(i, 1), view_column(i, 2), view_column(i, 3));
    return LightView(view_from_world, view_column(i, 4), view_column(i, 5), view_column(i, 6));
}

uniform sampler2D real_light_depth;
uniform sampler2D virtual_light_depth;
uniform sampler2D caster_distance;   // of virtual_light_depth: squared, in cells of CASTER_CELL x CASTER_CELL texels
uniform sampler2DArray mirror_visibility;   // r, g: fraction of an image that a plane shows without and with objects
#pragma texels r32f caster_distance
#include "common/lighting.glsl"
uniform int shadow_samples;

vec3 light_at(Light light, vec3 p, vec3 n, out vec3 to_light, out float angular_radius) {
    vec3 across = unmirrored_light_at(light, p, n, to_light, angular_radius);
    if (!is_image(light)) return across;
    bool before = dot(light.plane.xyz, p) + light.plane.w > 0.0;
    float cosine = max(-dot(light.plane.xyz, to_light), 1e-3);
    return before ? across * specular_reflectance(light.mirror.rgb, light.shape.w, cosine) : vec3(0.0);
}

// Fractions of a light that shine towards p without and with the objects: of a mirror image, what its plane shows; of a light that
// comes with an object none and all; 1 for others.
vec2 shining_fraction(Light light, vec3 p) {
    if (is_virtual(light)) return vec2(0.0, 1.0);
    if (!is_image(light)) return vec2(1.0);
    vec3 n = light.plane.xyz;
    bool distant = light.place.w == DIRECTIONAL;
    vec3 direction = distant ? -light.place.xyz : light.place.xyz - p;
    float part = max(dot(n, p) + light.plane.w, 0.0) / max(-dot(n, direction), 1e-6);   // fraction of the path up to the plane
    vec3 q = p + part * direction;
    float radius = is_rectangle(light) ? sqrt(length(light.axis_u.xyz) * length(light.axis_v.xyz)) : light.shape.x;
    float texels = 2.0 * radius * part * length(light.map_u.xyz) * float(textureSize(mirror_visibility, 0).x);
    vec2 uv = vec2(dot(light.map_u.xyz, q) + light.map_u.w, dot(light.map_v.xyz, q) + light.map_v.w);
    return textureLod(mirror_visibility, vec3(uv, light.mirror.w), log2(max(texels, 1.0))).rg;
}

vec3 light_at(Light light, vec3 p, out vec3 to_light, out float angular_radius) {
    return light_at(light, p, vec3(0.0), to_light, angular_radius);
}

vec2 lateral(LightView view, vec3 v) { return view.range.z > 0.5 ? v.xy : v.xy / max(v.z, 1e-6); }

float linear_depth(LightView view, float d) {
    float near = view.range.x, far = view.range.y;
    return view.range.z > 0.5 ? mix(near, far, d) : near * far / (far - d * (far - near));
}

// The map's depth of a distance along the view: linear_depth undone.
float map_depth(LightView view, float z) {
    float near = view.range.x, far = view.range.y;
    return view.range.z > 0.5 ? (z - near) / (far - near) : far * (z - near) / (z * (far - near));
}

// Texel coordinate (pixel centres at .5) of a lateral position; outside its tile: negative.
vec2 tile_texel(LightView view, vec2 s) {
    vec2 uv = 0.5 + 0.5 * s / view.tile.w;
    if (any(lessThan(uv, vec2(0.0))) || any(greaterThanEqual(uv, vec2(1.0)))) return vec2(-1.0);
    return view.tile.xy + uv * view.tile.z;
}

const float NOTHING = 1e30;
const float COMPARED_TEXELS = 2.0;   // beyond a sample's own place, by bilinear comparison and rounding
const float WIDE_TEXELS = 6.0;   // penumbrae wider than this get more samples

float first_depth(sampler2D map, LightView view, ivec2 texel) {
    float d = texelFetch(map, texel, 0).r;
    return d >= 1.0 ? NOTHING : linear_depth(view, d);
}

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
    vec4 d = textureGather(map, t / vec2(textureSize(map, 0)), 0);   // (0,1) (1,1) (1,0) (0,0)
    vec4 lit = vec4(greaterThanEqual(d, vec4(min(depth <= view.range.x ? 0.0 : map_depth(view, depth), 1.0))));
    vec2 f = fract(t - 0.5);
    return mix(mix(lit.w, lit.z, f.x), mix(lit.x, lit.y, f.x), f.y);
}

// A light's area as seen by a receiver on the map. At a blocker's depth the ray from the sample at offset o (on the
// unit disc, or in the square -1..1 of a rectangle) is shifted laterally by gap (u o.x + v o.y) / (1 - dot(lean, o)).
struct Spread { vec2 u; vec2 v; vec2 lean; float widest; bool square; };

const float STEEPEST_LEAN = 0.9;   // samples as deep in the view as the receiver count as this deep

Spread spread_of(Light light, LightView view, vec2 s, float depth) {
    float size = light.shape.x;
    Spread k = Spread(vec2(size, 0.0), vec2(0.0, size), vec2(0.0), size, is_rectangle(light));
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

vec2 shift_to(Spread k, float gap, vec2 o) {
    return k.square ? gap * (k.u * o.x + k.v * o.y) / (1.0 - dot(k.lean, o)) : gap * k.widest * o;
}

float square_norm(vec2 o) { return max(abs(o.x), abs(o.y)); }

float cross2(vec2 a, vec2 b) { return a.x * b.y - a.y * b.x; }

// Whether a shift, reduced by `margin`, is within the light's area (shift_to solved for o by Cramer's rule,
// undivided).
bool within_rectangle(Spread k, float gap, vec2 shift, float margin) {
    shift *= max(1.0 - margin / max(length(shift), 1e-12), 0.0);
    vec2 q = vec2(cross2(shift, k.v), cross2(k.u, shift));
    return square_norm(q) <= abs(gap * cross2(k.u, k.v) + dot(k.lean, q));
}

// Sample j of the light's area: a spiral on the unit disc, a Fibonacci lattice on the square.
vec2 light_sample(Spread k, int j, int count) {
    float along = (float(j) + 0.5) / float(count);
    float phi = float(j) * GOLDEN_ANGLE;
    return k.square ? 2.0 * vec2(along, fract(phi / (2.0 * PI))) - 1.0 : sqrt(along) * vec2(cos(phi), sin(phi));
}

// The view that shows p or, if none does, to whose tile it is nearest: a penumbra may reach beyond. Views around groups of objects
// are apart, and so are the penumbrae of what they show (passes/group_views.py).
int view_containing(int first, int count, vec3 p) {
    int found = first + count - 1, end = count > 1 ? first + count : first;
    float nearest = NOTHING;
    for (int i = first; i < end; ++i) {
        LightView view = listed_view(i);
        vec3 v = (view.view_from_world * vec4(p, 1.0)).xyz;
        vec2 s = abs(lateral(view, v));
        float beyond = v.z > 0.0 ? max(max(s.x, s.y) - view.tile.w, 0.0) : NOTHING;
        if (beyond < nearest) { nearest = beyond; found = i; }
    }
    return found;
}

// Every loop over a light's samples appears twice, once for discs and once for squares, with no iterations for the
// other kind: llvmpipe leaves a loop early, but executes both sides of a branch. Loops test at their end, because it runs
// the body of those that test at their beginning once more, for no lane.

struct Blocking { float sum; float hits; float deepest; };   // depths

void add_blocker(float d, inout Blocking found) {
    found = Blocking(found.sum + d, found.hits + 1.0, max(found.deepest, d));
}

// Of a disc. What lies within the light's area at a shift is nearer the light by an amount that grows with the shift: in the map's own
// depth, below a limit that falls linearly. Each sample is the one before, turned and moved outwards.
void add_disc_blockers(sampler2D map, Spread k, LightView view, Receiver r, int count, inout Blocking found) {
    float near = view.range.x, far = view.range.y, texels = 0.5 * view.tile.z / view.tile.w;
    float widest = count == 1 ? 0.0 : k.widest * drift(view, r.depth, near);
    float slope = (view.range.z > 0.5 ? 1.0 : near * far) / ((far - near) * max(k.widest, 1e-12));
    float nearer = min(map_depth(view, r.depth - r.bias), 1.0);
    float limit = map_depth(view, r.depth) + slope * 0.5 / texels;   // a shift counts beyond half a texel
    vec2 low = view.tile.xy, high = low + view.tile.z, centre = low + 0.5 * view.tile.z + texels * r.s;
    vec2 turn = vec2(cos(GOLDEN_ANGLE), sin(GOLDEN_ANGLE)), direction = vec2(1.0, 0.0);
    float apart = widest / float(count), shift = 0.5 * apart;
    int j = 0;
    if (count > 0) do {
        vec2 t = centre + texels * shift * direction;
        float d = texelFetch(map, ivec2(t), 0).r;
        bool in_tile = all(greaterThanEqual(t, low)) && all(lessThan(t, high));
        if (in_tile && d < min(nearer, limit - slope * shift)) add_blocker(linear_depth(view, d), found);
        direction = vec2(direction.x * turn.x - direction.y * turn.y, direction.x * turn.y + direction.y * turn.x);
        shift += apart;
    } while (++j < count);
}

void add_square_blockers(sampler2D map, Spread k, LightView view, Receiver r, int count, inout Blocking found) {
    k.square = true;
    float gap = drift(view, r.depth, view.range.x);
    float margin = view.tile.w / view.tile.z;   // half a texel
    int j = 0;
    if (count > 0) do {
        vec2 unit = light_sample(k, j, count);
        vec2 offset = count == 1 ? vec2(0.0) : shift_to(k, gap, square_norm(unit) * unit);
        vec2 t = tile_texel(view, r.s + offset);
        if (t.x < 0.0) continue;
        float d = first_depth(map, view, ivec2(t));
        if (d < r.depth - r.bias && within_rectangle(k, drift(view, r.depth, d), offset, margin)) add_blocker(d, found);
    } while (++j < count);
}

// Mean and greatest depth of the blockers of the light's area in one map; NOTHING if there are none. Only blockers
// inside the cone from the receiver to that area count, so that a tilted or noisy surface does not block itself.
// Samples are denser near the axis, because blockers near the receiver matter only there.
vec2 blockers(sampler2D map, Spread k, LightView view, Receiver r) {
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
struct Occluder { bool present; LightView view; Receiver receiver; Spread spread; vec2 blocker; vec2 gap; };

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
    o.spread = spread_of(light, o.view, o.receiver.s, o.receiver.depth);
    float reach = o.spread.widest * drift(o.view, o.receiver.depth, o.view.range.x);
    if (any(greaterThan(abs(o.receiver.s), vec2(o.view.tile.w + reach)))) return o;
    o.blocker = blockers(map, o.spread, o.view, o.receiver);
    o.present = o.blocker.x < NOTHING;
    for (int i = 0; i < 2; ++i) o.gap[i] = o.present ? drift(o.view, o.receiver.depth, o.blocker[i]) : 0.0;
    return o;
}

// Whether the ray to one sample of the light is unblocked, bilinearly: at the mean blocker's depth, and for a
// rectangle at the deepest one's too, because blockers near a large light are seldom flat. The receiver's plane may
// rise towards the light there, but things a quarter of the distance to the blockers above it do block.
float passes(sampler2D map, Occluder o, vec2 offset) {
    float lit = 1.0;
    for (int i = 0; i < (has_rectangles && o.spread.square ? 2 : 1); ++i) {
        vec2 s = o.receiver.s + shift_to(o.spread, o.gap[i], offset);
        float highest = mix(o.receiver.depth, o.blocker[i], 0.75);
        float depth = clamp(plane_depth(o.view, o.receiver, s), highest, o.receiver.depth);
        lit = min(lit, lit_fraction(map, o.view, s, depth - o.receiver.bias));
    }
    return lit;
}

const float CASTER_CELL = 8.0;

// Least distance of an object from a lateral position in its map, texels.
float texels_to_caster(LightView view, vec2 s) {
    vec2 t = (0.5 + 0.5 * s / view.tile.w) * view.tile.z, inside = clamp(t, vec2(0.5), vec2(view.tile.z - 0.5));
    vec2 first = view.tile.xy / view.tile.z * ceil(view.tile.z / CASTER_CELL);
    float from_inside = CASTER_CELL * sqrt(texelFetch(caster_distance, ivec2(first + inside / CASTER_CELL), 0).r);
    float outside = distance(t, inside);
    return max(from_inside - outside, outside);
}

// Whether a virtual object can stand between p and any part of a light; `in_box`: or anything that fills their map.
bool object_may_block(Light light, vec3 p, float bias, bool in_box) {
    bool found = false;
    int j = light.views.z, end = light.views.z + light.views.w;
    if (j < end) do {
        LightView view = listed_view(j);
        vec3 v = (view.view_from_world * vec4(p, 1.0)).xyz;
        if (v.z - bias <= view.range.x) continue;
        vec2 s = lateral(view, v);
        Spread k = spread_of(light, view, s, v.z);
        float texel = 2.0 * view.tile.w / view.tile.z, reach = k.widest * drift(view, v.z, view.range.x);
        found = in_box ? all(lessThanEqual(abs(s), vec2(view.tile.w + reach)))
                       : texels_to_caster(view, s) <= reach * (k.square ? sqrt(2.0) : 1.0) / texel + COMPARED_TEXELS;
    } while (++j < end && !found);
    return found;
}

// The same of all lights.
bool object_may_shadow(vec3 p, float bias, bool in_box) {
    for (int i = 0; i < light_count; ++i) {
        vec2 shown = shining_fraction(listed_light(i), p);
        if (shown.x != shown.y || object_may_block(listed_light(i), p, bias, in_box)) return true;
    }
    return false;
}

// Whether object_may_block may hold of a point within `radius` of p. The distance to casters is known in cells, so it
// may differ by two of their diagonals more than its points are apart.
bool object_may_block_sphere(Light light, vec3 p, float radius, float bias) {
    bool found = false;
    int j = light.views.z, end = light.views.z + light.views.w;
    if (j < end) do {
        LightView view = listed_view(j);
        vec3 v = (view.view_from_world * vec4(p, 1.0)).xyz;
        float deepest = v.z + radius, nearest = v.z - radius;
        if (deepest - bias <= view.range.x) continue;
        vec2 s = lateral(view, v);
        bool straight = view.range.z > 0.5;
        float apart = straight ? radius : radius * (1.0 + length(s)) / max(nearest, 1e-6);
        float texel = 2.0 * view.tile.w / view.tile.z, reach = light.shape.x * drift(view, deepest, view.range.x);
        found = (!straight && nearest <= 0.0)
            || texels_to_caster(view, s) <= (reach + apart) / texel + COMPARED_TEXELS + 2.0 * sqrt(2.0) * CASTER_CELL;
    } while (++j < end && !found);
    return found;
}

// Whether object_may_shadow may hold of a point within `radius` of p; of images and rectangles, only the points tell, and lights of
// objects reach all.
bool object_may_shadow_sphere(vec3 p, float radius, float bias) {
    if (has_rectangles || has_mirror_images || has_virtual_lights) return true;
    for (int i = 0; i < light_count; ++i)
        if (object_may_block_sphere(listed_light(i), p, radius, bias)) return true;
    return false;
}

// If the penumbra is many texels wide, few samples would show as steps.
int samples_for(Occluder o) {
    if (!o.present) return 1;
    float texels = o.spread.widest * o.gap.x * o.view.tile.z / (2.0 * o.view.tile.w);
    return texels > WIDE_TEXELS ? 4 * shadow_samples : shadow_samples;
}

// Weight of sample o of a rectangle in the irradiance, up to a factor; 1 for other lights, whose samples are equal.
float sample_weight(Light light, Spread k, vec3 p, vec3 n, vec2 o) {
    vec3 d = light.place.xyz + mat2x3(light.axis_u.xyz, light.axis_v.xyz) * o - p;
    float cosines = max(dot(d, n), 0.0) * max(-dot(d, cross(light.axis_u.xyz, light.axis_v.xyz)), 0.0);
    return k.square ? cosines / max(dot(d, d) * dot(d, d), 1e-12) : 1.0;
}

// Adds (v_mu, v_rho, 1) times its weight for each sample of the light's area.
void add_samples(
    bool square, Light light, Spread k, Occluder real, Occluder object, vec3 p, vec3 n, int count, inout vec3 sum
) {
    k.square = real.spread.square = object.spread.square = square;
    int j = 0;
    if (count > 0) do {
        vec2 offset = light_sample(k, j, count);
        float w = sample_weight(light, k, p, n, offset);
        float v = real.present ? passes(real_light_depth, real, offset) : 1.0;
        sum.xz += w * vec2(v, 1.0);
        if (object.present && v > 0.0) v *= passes(virtual_light_depth, object, offset);
        sum.y += w * v;
    } while (++j < count);
}

vec2 visible_fraction(Light light, Occluder real, Occluder object, vec3 p, vec3 n) {
    if (!real.present && !object.present) return vec2(1.0);
    int count = max(samples_for(real), samples_for(object));
    Spread k = real.present ? real.spread : object.spread;
    vec3 sum = vec3(0.0);
    add_samples(false, light, k, real, object, p, n, k.square ? 0 : count, sum);
    if (has_rectangles) add_samples(true, light, k, real, object, p, n, k.square ? count : 0, sum);
    return sum.z > 0.0 ? sum.xy / sum.z : vec2(1.0);
}

#ifdef TRANSMISSION   // a switch of the shaders that ask for it
#ifndef OPAQUE_SHADOWS
#define TINTED_SHADOWS
#endif
#endif
#ifdef TINTED_SHADOWS
layout(std430) readonly buffer Transmittances { vec4 transmittances[]; };   // of materials: rgb; alpha
uniform sampler2D virtual_light_normal;   // w: material
#pragma texels rgba16f virtual_light_normal

// Sum of what the objects' first surfaces around a receiver let through, and how many block it. What beams carry counts as blocked.
vec4 let_through(Light light, LightView view, vec3 p, float beam_alpha) {
    vec3 v = (view.view_from_world * vec4(p, 1.0)).xyz;
    vec2 s = lateral(view, v);
    Spread k = spread_of(light, view, s, v.z);
    vec4 sum = vec4(0.0);
    for (int j = 0; j < shadow_samples; ++j) {
        vec2 offset = shift_to(k, drift(view, v.z, view.range.x), light_sample(k, j, shadow_samples));
        vec2 t = tile_texel(view, s + offset);
        if (t.x < 0.0 || first_depth(virtual_light_depth, view, ivec2(t)) >= v.z) continue;
        vec4 through = transmittances[int(texelFetch(virtual_light_normal, ivec2(t), 0).w)];
        sum += vec4(through.a < beam_alpha ? vec3(0.0) : through.rgb, 1.0);
    }
    return sum;
}
#endif

// Fraction of a light's channels that arrives at p, of its visibility `seen` without and with the objects: transparent ones let some
// of what they block through. `beam_alpha`: of the roughest objects through which beams bring it.
vec3 arriving(Light light, vec3 p, vec2 seen, float beam_alpha) {
#ifdef TINTED_SHADOWS
    vec4 sum = vec4(0.0);
    if (light.views.w > 0 && seen.x > seen.y)
        sum = let_through(light, listed_view(view_containing(light.views.z, light.views.w, p)), p, beam_alpha);
    return vec3(seen.y) + max(seen.x - seen.y, 0.0) * sum.rgb / max(sum.a, 1.0);
#else
    return vec3(seen.y);
#endif
}

// V_mu, and V_rho but for the objects' shadows.
vec2 real_visibilities(Light light, vec3 p, vec3 n, float bias) {
    Occluder none;
    none.present = false;
    Occluder real = occluder(real_light_depth, light, light.views.x, light.views.y, p, n, bias);
    float seen = visible_fraction(light, real, none, p, n).x;
    float without = shining_fraction(light, p).x * seen;
    return vec2(without, is_virtual(light) ? seen : without);
}

// V_mu alone.
float real_visibility(Light light, vec3 p, vec3 n, float bias) { return real_visibilities(light, p, n, bias).x; }

// (V_mu, V_rho) at p with normal n: averages over the same samples of the light; v_rho = v_mu v_obj (docs/method.md
// 3). `bias_real`, `bias_virtual` (m) move the receiver towards the light.
vec2 visibility(Light light, vec3 p, vec3 n, float bias_real, float bias_virtual) {
    Occluder real = occluder(real_light_depth, light, light.views.x, light.views.y, p, n, bias_real);
    int views = object_may_block(light, p, bias_virtual, false) ? light.views.w : 0;
    Occluder object = occluder(virtual_light_depth, light, light.views.z, views, p, n, bias_virtual);
    return shining_fraction(light, p) * visible_fraction(light, real, object, p, n);
}
