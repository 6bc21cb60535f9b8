// Rays from smooth real surfaces, and their hits on the objects.
#include "common/mirror.glsl"
#include "common/ray_mesh.glsl"
#include "common/ray_pattern.glsl"

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
