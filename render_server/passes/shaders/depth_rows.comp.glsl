// Sums over the row of each pixel's window, of the known pixels: their number, offset, squared offset, w and w times the
// offset; and which jumps the row holds, to the right (1) and to the row below (2).
#include "common/depth_fit.glsl"

layout(local_size_x = 64) in;
uniform sampler2D inverse_depth;
uniform int window_radius;
layout(rgba32f) writeonly uniform image2D row_moments_out;   // number, offset, squared offset; jumps
layout(rg32f) writeonly uniform image2D row_depth_out;       // w, w times offset

float inverse_at(ivec2 pixel) {
    bool inside = all(greaterThanEqual(pixel, ivec2(0))) && all(lessThan(pixel, textureSize(inverse_depth, 0)));
    return inside ? texelFetch(inverse_depth, pixel, 0).r : 0.0;
}

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, textureSize(inverse_depth, 0)))) return;
    vec3 moments = vec3(0.0);
    vec2 depth = vec2(0.0);
    bool right = false, down = false;
    float w = inverse_at(pixel - ivec2(window_radius, 0));
    for (int i = -window_radius; i <= window_radius; ++i) {
        float next = inverse_at(pixel + ivec2(i + 1, 0)), offset = float(i);
        moments += w > 0.0 ? vec3(1.0, offset, offset * offset) : vec3(0.0);
        depth += w * vec2(1.0, offset);
        right = right || (i < window_radius && jumps(w, next));
        down = down || jumps(w, inverse_at(pixel + ivec2(i, 1)));
        w = next;
    }
    imageStore(row_moments_out, pixel, vec4(moments, float(right) + 2.0 * float(down)));
    imageStore(row_depth_out, pixel, vec4(depth, 0.0, 0.0));
}
