// For each texel of the reduced grid one point of the objects that its block of pixels reflects, listed if there is
// one.
#include "common/mirror_rays.glsl"
#define APPENDS_TEXELS
#include "common/work_list.glsl"

#include "common/pixel_group.glsl"
layout(rgba32f) writeonly uniform image2D position_out;   // world m; w: 1 if there is one
layout(rgba16f) writeonly uniform image2D normal_out;     // world; w: material
uniform isampler2D sample_pixels;
#pragma texels rgba16i sample_pixels
uniform int scale;

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy), size = textureSize(sample_pixels, 0);
    if (any(greaterThanEqual(texel, size))) return;
    imageStore(position_out, texel, vec4(0.0));
    ivec2 pixel = mirror_pixel(texelFetch(sample_pixels, texel, 0));
    if (pixel.x < 0) return;
    Mirror m = mirror_at(pixel);
    MeshHit hit = MeshHit(0.0, -1, vec2(0.0));
    Ray ray = Ray(vec3(0.0), vec3(0.0));
    for (int j = 0; m.present && hit.triangle < 0 && j < RAY_COUNT; ++j) {
        ray = lobe_ray(pixel, m, ray_numbers(pixel, j), float(scale));
        if (dot(ray.direction, m.normal) > 0.0) hit = closest_hit(ray);
    }
    if (hit.triangle < 0) return;
    MeshSurface s = surface_of(hit, ray);
    imageStore(position_out, texel, vec4(s.position, 1.0));
    imageStore(normal_out, texel, vec4(s.normal, float(s.material)));
    append_texel(texel, size.x);
}
