// Where the objects may change light: elsewhere the picture stays as it is.
#include "common/lights.glsl"
#include "common/geometry.glsl"
#include "common/volume.glsl"
#include "common/lit_area.glsl"
#include "common/continuation.glsl"
#ifdef SHADOW_CONES
#include "common/shadow_cone.glsl"
#endif
uniform float noise_sigma;   // m at 1 m

// Of a point, and of any point in a sphere around it; `bias`: m, the least of all points.
#ifdef SHADOW_CONES
bool shadow_may_reach(vec3 p, vec3 n, float bias) { return object_meets_cone(p, n); }
bool shadow_may_reach_sphere(vec3 p, float radius, float bias) { return object_meets_cone_of_sphere(p, radius); }
#elif defined(REAL_SHADOWS) || defined(SPARED)
bool shadow_may_reach(vec3 p, vec3 n, float bias) { return false; }
bool shadow_may_reach_sphere(vec3 p, float radius, float bias) { return false; }
#else
bool shadow_may_reach(vec3 p, vec3 n, float bias) { return object_may_shadow(p, bias, false); }
bool shadow_may_reach_sphere(vec3 p, float radius, float bias) { return object_may_shadow_sphere(p, radius, bias); }
#endif

float shadow_bias(float depth) { return 3.0 * noise_sigma * depth * depth; }

// Whether cones change the light here: in the volume, or so close that a texel of the reduced grid beside it is inside.
bool cones_may_reach(vec4 position, vec3 normal) {
    vec3 away = normalize(camera_position - position.xyz);
    float margin_m = 2.0 * sample_distance * position.w / max(dot(normal, away), 0.1);
    return near_volume(position.xyz, margin_m);
}

// Whether cones or shadows of the objects reach the real surface of a pixel.
bool light_may_change(ivec2 pixel, vec4 position, vec3 normal) {
    return position.w > 0.0
        && (is_in_lit_area(pixel) || cones_may_reach(position, normal)
            || shadow_may_reach(position.xyz, normal, shadow_bias(position.w)));
}
