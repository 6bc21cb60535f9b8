// World position and normal of the real surface at each pixel, from the clean depth map and its fitted normals
// (render_server/scene/depth_surface.py).
#include "common/surfaces.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
uniform sampler2D depth_map;       // m along the optical axis, 0 unknown
uniform sampler2D picture_rays;    // (x/z, y/z)
uniform sampler2D fitted_normals;  // optical frame; zero where unknown
layout(rgba32f) writeonly uniform image2D position_out;
layout(rgba16f) writeonly uniform image2D normal_out;
#include "common/camera.glsl"

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
    vec3 fitted = texelFetch(fitted_normals, pixel, 0).xyz;
    vec3 normal = mat3(world_from_camera) * normalize(fitted == vec3(0.0) ? -camera : fitted);
    imageStore(position_out, pixel, vec4(world, z));
    imageStore(normal_out, pixel, vec4(normal, float(surface_entry(world, -2.0))));
}
