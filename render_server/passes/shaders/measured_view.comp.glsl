// Copies what a camera measures, its linear picture and depth, into its layer of those of all cameras.
#include "common/camera_image.glsl"

#include "common/pixel_group.glsl"
layout(rgba16f) writeonly uniform image2DArray radiance_out;
layout(r32f) writeonly uniform image2DArray depth_out;
uniform int layer;

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(vec2(pixel), picture_size))) return;
    imageStore(radiance_out, ivec3(pixel, layer), texelFetch(linear_picture, pixel, 0));
    imageStore(depth_out, ivec3(pixel, layer), vec4(texelFetch(real_surface_position, pixel, 0).w));
}
