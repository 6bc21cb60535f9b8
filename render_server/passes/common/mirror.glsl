// Real surfaces that reflect virtual objects by rays: where they are, and which ways their GGX lobe sends a ray.
#include "passes/common/geometry.glsl"
#include "passes/common/surfaces.glsl"
#include "passes/common/ray_mesh.glsl"
#include "passes/common/lobe.glsl"
#include "passes/common/camera_pinhole.glsl"

uniform mat4 world_from_camera;
uniform vec3 camera_position;

struct Mirror { bool present; vec3 point; vec3 normal; float depth; float alpha; };

// The smooth surface that a pixel sees. A declared plane is flatter than its depth image: its own normal counts.
Mirror mirror_at(ivec2 pixel) {
    vec4 position = texelFetch(real_surface_position, pixel, 0);
    vec4 normal = texelFetch(real_surface_normal, pixel, 0);
    Mirror m = Mirror(false, position.xyz, normal.xyz, position.w, LEAST_ALPHA);
    if (position.w <= 0.0 || normal.w < 0.0) return m;
    SurfaceEntry e = surfaces[int(normal.w)];
    vec3 away = camera_position - position.xyz;
    if (e.region[0].w == PLANE) {
        m.normal = dot(e.region[1].xyz, away) < 0.0 ? -e.region[1].xyz : e.region[1].xyz;
        m.point -= m.normal * dot(m.point - e.region[0].xyz, m.normal);
    }
    m.alpha = max(e.surface.x * e.surface.x, LEAST_ALPHA);
    m.present = e.surface.x < RAY_ROUGHNESS && dot(m.normal, away) > 0.0;
    return m;
}

// Gradient noise of a pixel, even over any 3 x 3 of them (Jimenez 2014).
float pixel_noise(vec2 pixel) { return fract(52.9829189 * fract(dot(pixel, vec2(0.06711056, 0.00583715)))); }

// Ray j of RAY_COUNT: xy over the lobe, zw within the pixel. Each stands for an equal share of the lobe's energy, at its
// middle, so that no pixel has a longer tail than its neighbour; they are turned about from pixel to pixel, the same
// each frame.
vec4 ray_numbers(ivec2 pixel, int j) {
    vec3 even = float(j) * vec3(0.6180339887, 0.7548776662, 0.5698402910);   // golden ratio; Roberts 2018
    vec2 turn = vec2(pixel_noise(vec2(pixel)), pixel_noise(vec2(pixel.yx) + 47.0));
    return vec4(fract(even.x + turn.x), (float(j) + 0.5) / float(RAY_COUNT), fract(even.yz + turn.yx));
}

const float DEPTH_RANGE = 1.5;   // change of depth within the rays' pixels; beyond, the surface's own point serves

// A ray that the surface sends into its lobe towards the camera, reversed; `spread`: pixels that the rays start from.
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
