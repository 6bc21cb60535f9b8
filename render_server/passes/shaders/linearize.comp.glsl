// Camera code -> linear camera units; a = 0 where a channel is clipped.
#include "common/camera_codes.glsl"

#include "common/pixel_group.glsl"
layout(rgba16f) writeonly uniform image2D linear_out;
#pragma outputs linear_out

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, textureSize(picture, 0)))) return;
    uvec3 code = texelFetch(picture, pixel, 0).rgb;
    bool clipped = any(equal(code, uvec3(255u)));
    imageStore(linear_out, pixel, vec4(radiance_of(code), clipped ? 0.0 : 1.0));
}
