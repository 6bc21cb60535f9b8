// World position and normal of the real surface at each pixel, from the clean depth map.
// The normal is that of a plane fitted to 1/z, which is linear in x/z and y/z on a plane.
#include "passes/common/surfaces.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
layout(binding = 0) uniform sampler2D depth_map;       // m along the optical axis, 0 unknown
layout(binding = 1) uniform sampler2D picture_rays;    // (x/z, y/z)
layout(binding = 0, rgba32f) writeonly uniform image2D position_out;
layout(binding = 1, rgba16f) writeonly uniform image2D normal_out;
uniform mat4 world_from_camera;
uniform float noise_sigma;       // m at 1 m; grows with z^2
uniform int normal_stride;       // pixels between the 5 x 5 samples of the fit

// Camera-space normal; sum over the samples that lie on the same surface (METHOD 2).
vec3 fitted_normal(ivec2 pixel, float z, ivec2 size) {
    vec2 centre = texelFetch(picture_rays, pixel, 0).xy;
    float limit = 6.0 * noise_sigma * z * z + 0.02 * z;
    float sxx = 1e-12, sxy = 0.0, syy = 1e-12, sxw = 0.0, syw = 0.0, sx = 0.0, sy = 0.0, sw = 0.0, count = 0.0;
    for (int j = -2; j <= 2; ++j)
        for (int i = -2; i <= 2; ++i) {
            ivec2 at = pixel + normal_stride * ivec2(i, j);
            if (any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, size))) continue;
            float d = texelFetch(depth_map, at, 0).r;
            if (d <= 0.0 || abs(d - z) > limit) continue;
            vec2 r = texelFetch(picture_rays, at, 0).xy - centre;
            float w = 1.0 / d;
            sxx += r.x * r.x; sxy += r.x * r.y; syy += r.y * r.y;
            sxw += r.x * w; syw += r.y * w; sx += r.x; sy += r.y; sw += w; count += 1.0;
        }
    if (count < 5.0) return normalize(vec3(-centre, -1.0));
    sxx -= sx * sx / count; sxy -= sx * sy / count; syy -= sy * sy / count;
    sxw -= sx * sw / count; syw -= sy * sw / count;
    float det = sxx * syy - sxy * sxy;
    if (abs(det) < 1e-18) return normalize(vec3(-centre, -1.0));
    vec2 gradient = vec2(syy * sxw - sxy * syw, sxx * syw - sxy * sxw) / det;
    // 1/z = a x + b y + c  =>  a X + b Y + c Z = 1: the plane's normal is (a, b, c)
    vec3 plane = vec3(gradient, 1.0 / z - dot(gradient, centre));
    vec3 n = -normalize(plane);
    return dot(n, vec3(centre, 1.0)) > 0.0 ? -n : n;
}

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    ivec2 size = textureSize(depth_map, 0);
    if (any(greaterThanEqual(pixel, size))) return;
    float z = texelFetch(depth_map, pixel, 0).r;
    if (z <= 0.0) {
        imageStore(position_out, pixel, vec4(0.0));
        imageStore(normal_out, pixel, vec4(0.0, 0.0, 1.0, -1.0));
        return;
    }
    vec3 camera = vec3(texelFetch(picture_rays, pixel, 0).xy, 1.0) * z;
    vec3 world = (world_from_camera * vec4(camera, 1.0)).xyz;
    vec3 normal = mat3(world_from_camera) * fitted_normal(pixel, z, size);
    imageStore(position_out, pixel, vec4(world, z));
    imageStore(normal_out, pixel, vec4(normal, float(surface_entry(world, -2.0))));
}
