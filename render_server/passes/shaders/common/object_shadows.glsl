// Whether the virtual objects may stand between a point, or a sphere, and a light.
#include "common/soft_shadows.glsl"

uniform sampler2D caster_distance;   // of object_rsm_depth: squared, in cells of CASTER_CELL x CASTER_CELL texels
#pragma texels r32f caster_distance

const float COMPARED_TEXELS = 2.0;   // beyond a sample's own place, by bilinear comparison and rounding
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
        LightExtent k = light_extent(light, view, s, v.z);
        float texel = 2.0 * view.tile.w / view.tile.z, reach = k.widest * drift(view, v.z, view.range.x);
        found = in_box ? all(lessThanEqual(abs(s), vec2(view.tile.w + reach)))
                       : texels_to_caster(view, s) <= reach * (k.square ? sqrt(2.0) : 1.0) / texel + COMPARED_TEXELS;
    } while (++j < end && !found);
    return found;
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
        float footprint = straight ? radius : radius * (1.0 + length(s)) / max(nearest, 1e-6);
        float texel = 2.0 * view.tile.w / view.tile.z, reach = light.shape.x * drift(view, deepest, view.range.x);
        found = (!straight && nearest <= 0.0)
            || texels_to_caster(view, s) <= (reach + footprint) / texel + COMPARED_TEXELS + 2.0 * sqrt(2.0) * CASTER_CELL;
    } while (++j < end && !found);
    return found;
}
