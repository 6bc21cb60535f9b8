// Inverse depth, 0 where unknown, and where a pixel jumps to at least three of its neighbours: a spike, or a flying pixel
// between surfaces.
#include "common/depth_fit.glsl"

#include "common/pixel_group.glsl"
uniform sampler2D depth_map;   // m along the optical axis, 0 unknown
layout(r32f) writeonly uniform image2D inverse_out;

float inverse_at(ivec2 pixel) {
    float z = texelFetch(depth_map, clamp(pixel, ivec2(0), textureSize(depth_map, 0) - 1), 0).r;
    return z > 0.0 ? 1.0 / z : 0.0;
}

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, textureSize(depth_map, 0)))) return;
    float w = inverse_at(pixel);
    int count = int(jumps(w, inverse_at(pixel + ivec2(1, 0)))) + int(jumps(w, inverse_at(pixel + ivec2(0, 1))))
        + int(jumps(inverse_at(pixel - ivec2(1, 0)), w)) + int(jumps(inverse_at(pixel - ivec2(0, 1)), w));
    imageStore(inverse_out, pixel, vec4(count >= 3 ? 0.0 : w));
}
