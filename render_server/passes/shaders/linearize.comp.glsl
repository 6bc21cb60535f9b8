// Camera code -> linear camera units; a = 0 where a channel is clipped.
#include "common/camera_codes.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
layout(rgba16f) writeonly uniform image2D linear_out;

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, textureSize(picture, 0)))) return;
    uvec3 code = texelFetch(picture, pixel, 0).rgb;
    bool clipped = any(equal(code, uvec3(255u)));
    imageStore(linear_out, pixel, vec4(radiance_of(code), clipped ? 0.0 : 1.0));
}
