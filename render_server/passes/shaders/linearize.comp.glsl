// Camera code -> linear camera units; a = 0 where a channel is clipped. CLEARS: also clears buffers, for it is the frame's first kernel.
#include "common/camera_codes.glsl"

#include "common/pixel_group.glsl"
layout(rgba16f) writeonly uniform image2D linear_out;
#pragma outputs linear_out

#ifdef CLEARS
#include "common/cleared_starts.glsl"

void clear() {
    uint group = gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x, threads = gl_WorkGroupSize.x * gl_WorkGroupSize.y;
    clear_starts(group * threads + gl_LocalInvocationIndex, gl_NumWorkGroups.x * gl_NumWorkGroups.y * threads);
}
#else
void clear() {}
#endif

void main() {
    clear();
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, textureSize(picture, 0)))) return;
    uvec3 code = texelFetch(picture, pixel, 0).rgb;
    bool clipped = any(equal(code, uvec3(255u)));
    imageStore(linear_out, pixel, vec4(radiance_of(code), clipped ? 0.0 : 1.0));
}
