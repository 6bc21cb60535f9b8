// Texels of reflective shadow maps as bundles of light rays: their positions and their light (docs/method.md 4.1).
#include "common/lights.glsl"

// Index of the light that a view belongs to.
int light_of_view(int view) {
    int i = 0;
    for (; i < light_count - 1; ++i) {
        ivec4 views = listed_light(i).views;
        bool real = view >= views.x && view < views.x + views.y;
        if (real || (view >= views.z && view < views.z + views.w)) break;
    }
    return i;
}

vec2 texel_lateral(LightView view, ivec2 texel) {
    return (2.0 * (vec2(texel) + 0.5 - view.tile.xy) / view.tile.z - 1.0) * view.tile.w;
}

// Side of a texel at a depth, m.
float texel_side(LightView view, float depth) {
    float side = 2.0 * view.tile.w / view.tile.z;
    return view.range.z > 0.5 ? side : side * depth;
}

// World point on the ray of a lateral position.
vec3 ray_point(LightView view, vec2 s, float depth) {
    vec3 v = vec3(view.range.z > 0.5 ? s : s * depth, depth);
    return transpose(mat3(view.view_from_world)) * (v - view.view_from_world[3].xyz);
}

// Intensity in a world direction of travel, relative to color. A rectangle's is that of its far field, L A cos, as if
// emitted from its centre: its flux is right, its spread over near surfaces is too narrow.
float intensity_towards(Light light, vec3 d) {
    vec3 normal_area = 4.0 * cross(light.axis_u.xyz, light.axis_v.xyz);
    return is_rectangle(light) ? max(dot(d, normal_area), 0.0) : spot_fraction(light, d);
}

// Cosine between a texel's ray and the view's axis.
float cosine_to_axis(vec2 s) { return inversesqrt(1.0 + dot(s, s)); }

// Light of a texel's rays before any reflection: I dW, or E_perp A (no cosine: a tilted surface receives the same
// rays on a larger area).
vec3 texel_light(Light light, LightView view, vec2 s) {
    float side = 2.0 * view.tile.w / view.tile.z;
    vec3 parallel_rays = light.color.rgb * side * side;
    if (view.range.z > 0.5) return parallel_rays;
    float straight = cosine_to_axis(s);
    vec3 d = transpose(mat3(view.view_from_world)) * vec3(s, 1.0) * straight;
    return parallel_rays * straight * straight * straight * intensity_towards(light, d);
}

vec3 direction_to_light(Light light, vec3 p) {
    vec3 to_light; float radius;
    light_at(light, p, to_light, radius);
    return to_light;
}

const float LEAST_COSINE = 0.01;   // bounds the area of a surface that the light grazes

// Area of the surface at p, of normal n, that the rays of a texel light, m^2.
float lit_area(Light light, LightView view, vec2 s, vec3 p, vec3 n) {
    float side = 2.0 * view.tile.w / view.tile.z, across = side * side;
    if (view.range.z < 0.5) {
        vec3 way = p - ray_point(view, s, 0.0);
        float straight = cosine_to_axis(s);
        across *= dot(way, way) * straight * straight * straight;
    }
    return across / max(abs(dot(n, direction_to_light(light, p))), LEAST_COSINE);
}

struct Hit { bool present; ivec2 texel; LightView view; vec2 s; float depth; float ray_depth; };

// The first surface that the light sees along its ray through p: in the real map views.xy, in that of the objects
// views.zw. `ray_depth` is the depth of p itself.
Hit first_hit(sampler2D map, int first, int count, vec3 p) {
    Hit hit;
    hit.present = false;
    if (count == 0) return hit;
    hit.view = listed_view(view_containing(first, count, p));
    vec3 v = (hit.view.view_from_world * vec4(p, 1.0)).xyz;
    if (v.z <= 0.0 && hit.view.range.z < 0.5) return hit;   // parallel rays also come from in front of the view
    hit.ray_depth = v.z;
    hit.s = lateral(hit.view, v);
    vec2 t = tile_texel(hit.view, hit.s);
    if (t.x < 0.0) return hit;
    hit.texel = ivec2(t);
    hit.depth = first_depth(map, hit.view, hit.texel);
    hit.present = hit.depth < NOTHING;
    return hit;
}

const float HIT_REACH = 2.0;   // texels along the ray from a texel's centre; limits hit points where the normal is across the ray

// Bound on the distance of a texel's hit points from its centre, m: half its diagonal sideways, HIT_REACH along the
// ray.
float hit_spread(LightView view, vec2 s, float depth) {
    float slant = view.range.z > 0.5 ? 1.0 : length(vec3(s, 1.0));
    return (HIT_REACH + 1.0) * texel_side(view, depth) * slant;
}

// Intersection of the ray with the texel's surface: the plane through the texel's centre with its normal.
vec3 hit_point(Hit hit, vec3 normal) {
    vec3 centre = ray_point(hit.view, texel_lateral(hit.view, hit.texel), hit.depth);
    vec3 a = ray_point(hit.view, hit.s, 0.0);
    vec3 b = ray_point(hit.view, hit.s, 1.0);
    float across = dot(normal, b - a);
    if (abs(across) < 1e-3) return centre;
    float reach = HIT_REACH * texel_side(hit.view, hit.depth);
    float depth = clamp(dot(normal, centre - a) / across, hit.depth - reach, hit.depth + reach);
    return ray_point(hit.view, hit.s, depth);
}
