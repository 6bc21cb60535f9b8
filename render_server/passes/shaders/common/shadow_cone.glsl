// Shadow cones ([P1] eq. 4): C_s is the opacity along a cone as wide as the light. It is marched only near the
// objects: only they remove light that is still in the picture, while occlusion by the real scene is in V_mu. So
// T_delta = -C_s E V_mu cos, and a real shadow is not cast twice (docs/method.md 3, direct). Each volume's own objects are met in its
// voxels, also from outside.
#include "common/march_joint.glsl"
#include "common/lights.glsl"
#include "common/object_box.glsl"

uniform sampler3D joint_mipmap;

const float SHADOW_START = 2.0;   // voxels along the normal, to leave the receiver's own voxels

struct ShadowCone { vec3 start; vec3 d; float ratio; vec2 interval; };

// Through the volume at hand.
ShadowCone shadow_cone(Light light, vec3 p, vec3 n) {
    vec3 to_light; float radius;
    light_at(light, p, n, to_light, radius);
    ShadowCone cone;
    cone.start = volume_coordinate(p) + SHADOW_START * n;
    cone.d = to_light;
    cone.ratio = 2.0 * tan(radius);
    float away = distance(cone.start, 0.5 * (object_low() + object_high()));
    vec3 margin = vec3(0.5 + 0.5 * max(1.0, cone.ratio * away));
    cone.interval = box_interval(cone.start, to_light, object_low() - margin, object_high() + margin);
    if (light.place.w > 0.5)
        cone.interval.y = min(cone.interval.y, distance(volume_coordinate(light.place.xyz), cone.start));
    return cone;
}

// Whether any shadow cone from p meets the objects.
bool object_meets_cone(vec3 p, vec3 n) {
    if (has_object_lamps) return true;   // they reach all
    for (int chosen = 0; chosen < volume_count; ++chosen) {
        work_in_volume(chosen);
        for (int i = 0; i < light_count; ++i) {
            vec2 interval = shadow_cone(listed_light(i), p, n).interval;
            if (interval.x < interval.y) return true;
        }
    }
    return false;
}

const float OFF_CONE = 0.5;       // voxels, for rounding

bool own_object_meets_cone_of_sphere(vec3 p, float radius) {
    vec3 q = volume_coordinate(p);
    for (int i = 0; i < light_count; ++i) {
        Light light = listed_light(i);
        bool distant = light.place.w == DIRECTIONAL;
        vec3 way = distant ? -light.place.xyz : volume_coordinate(light.place.xyz) - q;
        float far = length(way), slack = radius / voxel_edge + 2.0 * SHADOW_START + OFF_CONE;
        float sine = distant ? sin(atan(light.shape.x)) : light.shape.x / (voxel_edge * max(far - slack, 1e-6));
        if (sine >= 0.5) return true;
        float away = distance(q, 0.5 * (object_low() + object_high())) + slack;
        vec3 margin = vec3(0.5 + 0.5 * max(1.0, 2.0 * tan(asin(sine)) * away) + slack);
        vec2 interval = box_interval(q, way / far, object_low() - margin, object_high() + margin);
        if (!distant) interval.y = min(interval.y, far);
        if (interval.x < interval.y) return true;
    }
    return false;
}

// Whether object_meets_cone may hold of a point within `radius` (m) of p, whatever its normal; of images and rectangles,
// only the points tell. Cones of positions start and end SHADOW_START beside the segment from a point to the light.
bool object_meets_cone_of_sphere(vec3 p, float radius) {
    if (has_rectangles || has_mirror_images || has_object_lamps) return true;
    bool meets = false;
    for (int chosen = 0; chosen < volume_count; ++chosen) {
        work_in_volume(chosen);
        meets = meets || own_object_meets_cone_of_sphere(p, radius);
    }
    return meets;
}

// (V_mu, V_rho); `on_real` as for visibility.
vec2 cone_visibility(Light light, vec3 p, vec3 on_real, vec3 n, float bias) {
    vec2 seen = real_visibilities(light, on_real, n, bias);
    for (int chosen = 0; chosen < volume_count; ++chosen) {
        work_in_volume(chosen);
        ShadowCone cone = shadow_cone(light, p, n);
        if (seen.y == 0.0 || cone.interval.x >= cone.interval.y) continue;
        seen.y *= 1.0 - march(joint_mipmap, cone.start, cone.d, cone.ratio, cone.interval).a;
    }
    return seen;
}
