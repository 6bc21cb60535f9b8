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

float first_depth(sampler2D map, LightView view, ivec2 texel) {
    float d = texelFetch(map, texel, 0).r;
    return d >= 1.0 ? NOTHING : linear_depth(view, d);
}

// Bilinear comparison: share of the 2x2 texels around s that lie behind `depth`.
float lit_share(sampler2D map, LightView view, vec2 s, float depth) {
    vec2 t = tile_texel(view, s);
    if (t.x < 0.0) return 1.0;
    vec2 low = view.tile.xy, high = view.tile.xy + view.tile.z - 1.0;
    vec2 base = floor(t - 0.5), f = t - 0.5 - base;
    ivec2 a = ivec2(clamp(base, low, high)), b = ivec2(clamp(base + 1.0, low, high));
    vec4 lit = vec4(
        first_depth(map, view, a) >= depth, first_depth(map, view, ivec2(b.x, a.y)) >= depth,
        first_depth(map, view, ivec2(a.x, b.y)) >= depth, first_depth(map, view, b) >= depth);
    return mix(mix(lit.x, lit.y, f.x), mix(lit.z, lit.w, f.x), f.y);
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

// Mean depth of what blocks the light's disc in one map; NOTHING if nothing does.
float mean_blocker(sampler2D map, Light light, LightView view, vec2 s, float depth) {
    float widest = disc_shift(light, view, depth, view.range.x);
    int count = widest * view.tile.z < view.tile.w ? 1 : (shadow_samples + 1) / 2;   // below half a texel: one look
    float sum = 0.0, hits = 0.0;
    for (int j = 0; j < count; ++j) {
        vec2 t = tile_texel(view, count == 1 ? s : s + widest * disc_sample(j, count));
        if (t.x < 0.0) continue;
        float d = first_depth(map, view, ivec2(t));
        if (d < depth) { sum += d; hits += 1.0; }
    }
    if (hits == 0.0) return lit_share(map, view, s, depth) < 1.0 ? depth : NOTHING;
    return sum / hits;
}

struct Occluder { bool present; LightView view; vec2 s; float depth; float shift; };

Occluder occluder(sampler2D map, Light light, int first, int count, vec3 p, float bias) {
    Occluder o;
    o.present = false;
    if (count == 0) return o;
    o.view = light_views[view_containing(first, count, p)];
    vec3 v = (o.view.view_from_world * vec4(p, 1.0)).xyz;
    o.depth = v.z - bias;
    if (o.depth <= o.view.range.x) return o;
    o.s = lateral(o.view, v);
    float reach = disc_shift(light, o.view, o.depth, o.view.range.x);
    if (any(greaterThan(abs(o.s), vec2(o.view.tile.w + reach)))) return o;
    float blocker = mean_blocker(map, light, o.view, o.s, o.depth);
    o.present = blocker < NOTHING;
    o.shift = o.present ? disc_shift(light, o.view, o.depth, blocker) : 0.0;
    return o;
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

// (V_mu, V_rho): averages over the same samples of the light; v_rho = v_mu v_obj (METHOD 3).
// `bias_real`, `bias_virtual` (m) move the receiver towards the light.
vec2 visibility(Light light, vec3 p, float bias_real, float bias_virtual) {
    Occluder real = occluder(real_light_depth, light, light.views.x, light.views.y, p, bias_real);
    Occluder object = occluder(virtual_light_depth, light, light.views.z, light.views.w, p, bias_virtual);
    if (!real.present && !object.present) return vec2(1.0);
    vec2 sum = vec2(0.0);
    for (int j = 0; j < shadow_samples; ++j) {
        vec2 offset = disc_sample(j, shadow_samples);
        float v = 1.0;
        if (real.present) v = lit_share(real_light_depth, real.view, real.s + real.shift * offset, real.depth);
        sum.x += v;
        if (object.present && v > 0.0)
            v *= lit_share(virtual_light_depth, object.view, object.s + object.shift * offset, object.depth);
        sum.y += v;
    }
    return sum / float(shadow_samples);
}
