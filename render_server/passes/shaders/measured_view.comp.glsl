// Copies what a camera measures into its layer of those of all cameras: depth, or with PICTURE the means of squares of pixels.
#include "common/camera_image.glsl"

#include "common/pixel_group.glsl"
uniform int layer;
#ifdef PICTURE
layout(rgba16f) writeonly uniform image2DArray radiance_out;
uniform int block;   // pixels along an axis, that a texel holds the mean of

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy), last = ivec2(picture_size) - 1;
    if (any(greaterThan(block * texel, last))) return;
    vec4 sum = vec4(0.0);
    for (int i = 0; i < block * block; ++i)
        sum += texelFetch(linear_picture, min(block * texel + ivec2(i % block, i / block), last), 0);
    imageStore(radiance_out, ivec3(texel, layer), sum / float(block * block));
}
#else
layout(r32f) writeonly uniform image2DArray depth_out;

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(vec2(pixel), picture_size))) return;
    imageStore(depth_out, ivec3(pixel, layer), vec4(texelFetch(real_surface_position, pixel, 0).w));
}
#endif
