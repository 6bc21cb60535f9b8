// Lights, and their soft visibility with and without the virtual objects (docs/method.md 3.1).
#include "common/brdf.glsl"
#include "common/light_shapes.glsl"
#include "common/lighting.glsl"

uniform sampler2DArray mirror_visibility;   // r, g: fraction of an image that a plane shows without and with objects

// E_perp of a light or of a mirror image, as `unmirrored_light_at` returns it.
vec3 light_at(Light light, vec3 p, vec3 n, out vec3 to_light, out float angular_radius) {
    vec3 e_perp = unmirrored_light_at(light, p, n, to_light, angular_radius);
    if (!is_image(light)) return e_perp;
    bool before = dot(light.plane.xyz, p) + light.plane.w > 0.0;
    float cosine = max(-dot(light.plane.xyz, to_light), 1e-3);
    return before ? e_perp * specular_reflectance(light.mirror.rgb, light.shape.w, cosine) : vec3(0.0);
}

// Fractions of a light that shine towards p without and with the objects: of a mirror image, what its plane shows; of a light that
// comes with an object none and all; 1 for others.
vec2 shining_fraction(Light light, vec3 p) {
    if (is_object_lamp(light)) return vec2(0.0, 1.0);
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

#include "common/soft_shadows.glsl"
#include "common/object_shadows.glsl"
#include "common/tinted_shadows.glsl"

// Whether an object can change how much of any light arrives at p; `in_box` as for object_may_block.
bool object_may_shadow(vec3 p, float bias, bool in_box) {
    for (int i = 0; i < light_count; ++i) {
        vec2 shown = shining_fraction(listed_light(i), p);
        if (shown.x != shown.y || object_may_block(listed_light(i), p, bias, in_box)) return true;
    }
    return false;
}

// Whether object_may_shadow may hold of a point within `radius` of p; of images and rectangles, only the points tell, and lights of
// objects reach all.
bool object_may_shadow_sphere(vec3 p, float radius, float bias) {
    if (has_rectangles || has_mirror_images || has_object_lamps) return true;
    for (int i = 0; i < light_count; ++i)
        if (object_may_block_sphere(listed_light(i), p, radius, bias)) return true;
    return false;
}

// V_mu, and V_rho but for the objects' shadows.
vec2 real_visibilities(Light light, vec3 p, vec3 n, float bias) {
    Occluder none;
    none.present = false;
    Occluder real = occluder(real_rsm_depth, light, light.views.x, light.views.y, p, n, bias);
    float seen = visible_fraction(light, real, none, p, n).x;
    float without = shining_fraction(light, p).x * seen;
    return vec2(without, is_object_lamp(light) ? seen : without);
}

// V_mu alone.
float real_visibility(Light light, vec3 p, vec3 n, float bias) { return real_visibilities(light, p, n, bias).x; }

// (V_mu, V_rho) at p with normal n: averages over the same samples of the light; v_rho = v_mu v_obj (docs/method.md
// 3). `bias_real`, `bias_object` (m) move the receiver towards the light; `on_real`: p where the real scene's maps show it.
vec2 visibility(Light light, vec3 p, vec3 on_real, vec3 n, float bias_real, float bias_object) {
    Occluder real = occluder(real_rsm_depth, light, light.views.x, light.views.y, on_real, n, bias_real);
    int views = object_may_block(light, p, bias_object, false) ? light.views.w : 0;
    Occluder object = occluder(object_rsm_depth, light, light.views.z, views, p, n, bias_object);
    return shining_fraction(light, p) * visible_fraction(light, real, object, p, n);
}

vec2 visibility(Light light, vec3 p, vec3 n, float bias_real, float bias_object) {
    return visibility(light, p, p, n, bias_real, bias_object);
}
