// Lights, their depth maps, and soft visibility with and without the virtual objects (METHOD 3, direct).
#include "passes/common/basis.glsl"

struct Light {
    vec4 place;    // xyz: direction of travel (directional) or position in m (sphere); w: 0 directional, 1 sphere
    vec4 color;    // rgb: E_perp (directional) or intensity I (sphere), camera units
    vec4 shape;    // x: tan(angular radius) (directional) or radius in m (sphere)
    ivec4 views;   // first view and count in the real atlas, first and count in the virtual atlas
};

struct LightView {
    mat4 view_from_world;   // light at the origin (sphere), looking along +z
    vec4 tile;              // x, y, size in texels; half extent (m for directional, tangent for sphere)
    vec4 range;             // near, far in m; 1 if orthographic; 0
};

layout(std430, binding = 0) readonly buffer Lights { Light lights[]; };
layout(std430, binding = 1) readonly buffer LightViews { LightView light_views[]; };
layout(binding = 10) uniform sampler2D real_light_depth;
layout(binding = 11) uniform sampler2D virtual_light_depth;
uniform int light_count;
uniform int shadow_samples;

// Irradiance across the beam at p and the direction towards the light.
vec3 light_at(Light light, vec3 p, out vec3 to_light, out float angular_radius) {
    if (light.place.w == 0.0) {
        to_light = -light.place.xyz;
        angular_radius = atan(light.shape.x);
        return light.color.rgb;
    }
    vec3 d = light.place.xyz - p;
    float distance2 = max(dot(d, d), 1e-8);
    to_light = d * inversesqrt(distance2);
    angular_radius = asin(min(light.shape.x * inversesqrt(distance2), 1.0));
    return light.color.rgb / distance2;
}

vec2 lateral(LightView view, vec3 v) { return view.range.z > 0.5 ? v.xy : v.xy / max(v.z, 1e-6); }

float linear_depth(LightView view, float d) {
    float near = view.range.x, far = view.range.y;
    return view.range.z > 0.5 ? mix(near, far, d) : near * far / (far - d * (far - near));
}

// Texel coordinate (pixel centres at .5) of a lateral position; outside its tile: negative.
vec2 tile_texel(LightView view, vec2 s) {
    vec2 uv = 0.5 + 0.5 * s / view.tile.w;
    if (any(lessThan(uv, vec2(0.0))) || any(greaterThanEqual(uv, vec2(1.0)))) return vec2(-1.0);
    return view.tile.xy + uv * view.tile.z;
}

const float NOTHING = 1e30;
const float WIDE_TEXELS = 6.0;   // penumbrae wider than this get more samples

float first_depth(sampler2D map, LightView view, ivec2 texel) {
    float d = texelFetch(map, texel, 0).r;
    return d >= 1.0 ? NOTHING : linear_depth(view, d);
}

// A receiver in a light's view: its plane, so that a tilted surface does not block its own surroundings.
struct Receiver { vec2 s; float depth; vec3 normal; float plane; float bias; };

const float DEPTH_ROUNDING = 1e-4;   // relative: no surface blocks itself by the rounding of its own depth

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

// Bilinear comparison: share of the 2x2 texels around s that lie no nearer to the light than `depth`.
float lit_share(sampler2D map, LightView view, vec2 s, float depth) {
    vec2 t = tile_texel(view, s);
    if (t.x < 0.0) return 1.0;
    t = clamp(t, view.tile.xy + 0.5, view.tile.xy + view.tile.z - 0.5);
    vec4 d = textureGather(map, t / vec2(textureSize(map, 0)), 0);   // (0,1) (1,1) (1,0) (0,0)
    float near = view.range.x, far = view.range.y;
    float limit = view.range.z > 0.5 ? (depth - near) / (far - near) : far * (depth - near) / (depth * (far - near));
    vec4 lit = vec4(greaterThanEqual(d, vec4(min(depth <= near ? 0.0 : limit, 1.0))));
    vec2 f = fract(t - 0.5);
    return mix(mix(lit.w, lit.z, f.x), mix(lit.x, lit.y, f.x), f.y);
}

vec2 disc_sample(int j, int count) {
    float r = sqrt((float(j) + 0.5) / float(count));
    float phi = float(j) * GOLDEN_ANGLE;
    return r * vec2(cos(phi), sin(phi));
}

// Lateral shift on the map, per unit of disc offset, of the ray from a light sample at depth `blocker`.
float disc_shift(Light light, LightView view, float receiver, float blocker) {
    if (view.range.z > 0.5) return light.shape.x * max(receiver - blocker, 0.0);
    return light.shape.x * max(1.0 / blocker - 1.0 / receiver, 0.0);
}

int view_containing(int first, int count, vec3 p) {
    for (int i = first; i < first + count - 1; ++i) {
        LightView view = light_views[i];
        vec3 v = (view.view_from_world * vec4(p, 1.0)).xyz;
        if (v.z > 0.0 && all(lessThanEqual(abs(lateral(view, v)), vec2(view.tile.w)))) return i;
    }
    return first + count - 1;
}

// Mean depth of what blocks the light's disc in one map; NOTHING if nothing does. Only what lies inside the cone from
// the receiver to the disc counts, so that a tilted or noisy surface does not block itself. Samples crowd towards the
// axis, because what is near the receiver matters only there.
float mean_blocker(sampler2D map, Light light, LightView view, Receiver r) {
    float widest = disc_shift(light, view, r.depth, view.range.x);
    float texel = 2.0 * view.tile.w / view.tile.z;
    int count = widest < 0.5 * texel ? 1   // below half a texel: one look
        : widest > WIDE_TEXELS * texel ? 2 * shadow_samples : shadow_samples;
    float sum = 0.0, hits = 0.0;
    for (int j = 0; j < count; ++j) {
        vec2 unit = disc_sample(j, count);
        vec2 offset = count == 1 ? vec2(0.0) : widest * length(unit) * unit;
        vec2 t = tile_texel(view, r.s + offset);
        if (t.x < 0.0) continue;
        float d = first_depth(map, view, ivec2(t));
        if (d < r.depth - r.bias && length(offset) <= disc_shift(light, view, r.depth, d) + 0.5 * texel) {
            sum += d;
            hits += 1.0;
        }
    }
    if (hits == 0.0) return lit_share(map, view, r.s, r.depth - r.bias) < 1.0 ? r.depth : NOTHING;
    return sum / hits;
}

const float STEEPEST = 3.0;   // slope up to which a texel's rise is allowed for

struct Occluder { bool present; LightView view; Receiver receiver; float blocker; float shift; };

Occluder occluder(sampler2D map, Light light, int first, int count, vec3 p, vec3 n, float bias) {
    Occluder o;
    o.present = false;
    if (count == 0) return o;
    o.view = light_views[view_containing(first, count, p)];
    o.receiver = receiver_at(o.view, p, n, bias);
    // What a tilted surface rises within a texel of the map must not block it either.
    float texel = 2.0 * o.view.tile.w / o.view.tile.z * (o.view.range.z > 0.5 ? 1.0 : o.receiver.depth);
    float slope = (abs(o.receiver.normal.x) + abs(o.receiver.normal.y)) / -o.receiver.normal.z;   // of texels askew too
    o.receiver.bias += texel * min(slope, STEEPEST);
    if (o.receiver.depth - o.receiver.bias <= o.view.range.x) return o;
    float reach = disc_shift(light, o.view, o.receiver.depth, o.view.range.x);
    if (any(greaterThan(abs(o.receiver.s), vec2(o.view.tile.w + reach)))) return o;
    o.blocker = mean_blocker(map, light, o.view, o.receiver);
    o.present = o.blocker < NOTHING;
    o.shift = o.present ? disc_shift(light, o.view, o.receiver.depth, o.blocker) : 0.0;
    return o;
}

// Whether the ray to one sample of the light (offset on its unit disc) gets through, bilinearly. The receiver's plane
// may rise towards the light there, but what stands a quarter of the way to the blockers above it does block.
float passes(sampler2D map, Occluder o, vec2 offset) {
    vec2 s = o.receiver.s + o.shift * offset;
    float highest = mix(o.receiver.depth, o.blocker, 0.75);
    float depth = clamp(plane_depth(o.view, o.receiver, s), highest, o.receiver.depth);
    return lit_share(map, o.view, s, depth - o.receiver.bias);
}

// Whether a virtual object can stand between p and any part of any light.
bool object_may_shadow(vec3 p, float bias) {
    for (int i = 0; i < light_count; ++i) {
        Light light = lights[i];
        for (int j = light.views.z; j < light.views.z + light.views.w; ++j) {
            LightView view = light_views[j];
            vec3 v = (view.view_from_world * vec4(p, 1.0)).xyz;
            float depth = v.z - bias;
            if (depth <= view.range.x) continue;
            float reach = disc_shift(light, view, depth, view.range.x);
            if (all(lessThanEqual(abs(lateral(view, v)), vec2(view.tile.w + reach)))) return true;
        }
    }
    return false;
}

// Where the penumbra is many texels wide, few samples would show as steps.
int samples_for(Occluder o) {
    if (!o.present) return 1;
    float texels = o.shift * o.view.tile.z / (2.0 * o.view.tile.w);
    return texels > WIDE_TEXELS ? 4 * shadow_samples : shadow_samples;
}

// V_mu alone.
float real_visibility(Light light, vec3 p, vec3 n, float bias) {
    Occluder real = occluder(real_light_depth, light, light.views.x, light.views.y, p, n, bias);
    if (!real.present) return 1.0;
    int count = samples_for(real);
    float sum = 0.0;
    for (int j = 0; j < count; ++j) sum += passes(real_light_depth, real, disc_sample(j, count));
    return sum / float(count);
}

// (V_mu, V_rho) at p with normal n: averages over the same samples of the light; v_rho = v_mu v_obj (METHOD 3).
// `bias_real`, `bias_virtual` (m) move the receiver towards the light.
vec2 visibility(Light light, vec3 p, vec3 n, float bias_real, float bias_virtual) {
    Occluder real = occluder(real_light_depth, light, light.views.x, light.views.y, p, n, bias_real);
    Occluder object = occluder(virtual_light_depth, light, light.views.z, light.views.w, p, n, bias_virtual);
    if (!real.present && !object.present) return vec2(1.0);
    int count = max(samples_for(real), samples_for(object));
    vec2 sum = vec2(0.0);
    for (int j = 0; j < count; ++j) {
        vec2 offset = disc_sample(j, count);
        float v = real.present ? passes(real_light_depth, real, offset) : 1.0;
        sum.x += v;
        if (object.present && v > 0.0) v *= passes(virtual_light_depth, object, offset);
        sum.y += v;
    }
    return sum / float(count);
}
