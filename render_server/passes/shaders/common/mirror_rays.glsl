// Rays from smooth surfaces, and their hits on the objects.
#include "common/ray_mesh.glsl"
#include "common/mirror.glsl"
#include "common/ray_pattern.glsl"

#ifdef OF_OBJECTS
#include "common/surface_change.glsl"

const float CLEAR = 1e-3;   // of the depth: distance of a ray's start from its own surface

// A ray from the camera, reflected by a sample of the lobe of a surface that may be curved; `spread`: pixels that the rays start from.
Ray lobe_ray(ivec2 pixel, Mirror m, vec4 numbers, float spread) {
    vec4 position = vec4(m.point, m.depth), normal = vec4(m.normal, mirror_entry(pixel));
    Change x = change_along(pixel, ivec2(1, 0), position, normal, m.of_coat);
    Change y = change_along(pixel, ivec2(0, 1), position, normal, m.of_coat);
    vec2 within = spread * (numbers.zw - 0.5);
    vec3 aside = within.x * x.position + within.y * y.position;
    vec3 from = m.point + aside - m.normal * dot(aside, m.normal);   // on the tangent plane: not within a ball
    mat3 basis = basis_around(normalize(m.normal + within.x * x.normal + within.y * y.normal));
    vec3 v = normalize(camera_position - from);
    vec3 h = basis * visible_normal(numbers.xy, v * basis, m.alpha);
    return Ray(from + CLEAR * m.depth * m.normal, normalize(2.0 * dot(v, h) * h - v));
}
#else
const float DEPTH_RANGE = 1.5;   // change of depth within the rays' pixels; beyond, all start at the surface's own point

// A ray from the camera, reflected by a sample of the surface's lobe; `spread`: pixels that the rays start from.
Ray lobe_ray(ivec2 pixel, Mirror m, vec4 numbers, float spread) {
    vec2 slope = texelFetch(picture_rays, pixel, 0).xy + spread * (numbers.zw - 0.5) / camera_pinhole.xy;
    vec3 seen = mat3(world_from_camera) * vec3(slope, 1.0);
    float depth = dot(m.point - camera_position, m.normal) / dot(seen, m.normal);
    bool flat_enough = depth > m.depth / DEPTH_RANGE && depth < m.depth * DEPTH_RANGE;
    vec3 from = flat_enough ? camera_position + depth * seen : m.point;
    mat3 basis = basis_around(m.normal);
    vec3 v = normalize(camera_position - from);
    vec3 h = basis * visible_normal(numbers.xy, v * basis, m.alpha);
    return Ray(from, normalize(2.0 * dot(v, h) * h - v));
}
#endif
