// Inverse depth, 0 where unknown, and where a pixel jumps to at least three of its neighbours: a spike, or a flying pixel
// between surfaces. Its sums over the row of each pixel's window, of the known pixels: their number, offset, squared offset, w and
// w times the offset; and which jumps the row holds, to the right (1) and to the row below (2).
#include "common/depth_fit.glsl"

layout(local_size_x = 64) in;
uniform sampler2D depth_map;   // m along the optical axis, 0 unknown
uniform int window_radius;     // at most MAX_RADIUS
layout(r32f) writeonly uniform image2D inverse_out;
layout(rgba32f) writeonly uniform image2D row_moments_out;   // number, offset, squared offset; jumps
layout(rg32f) writeonly uniform image2D row_depth_out;       // w, w times offset

const int WIDTH = 64, SPAN = WIDTH + 2 * MAX_RADIUS + 1;
shared float inverse_depths[2][SPAN];   // of this row and the one below: the workgroup's pixels and what their windows hold beside

float inverse_at(ivec2 pixel) {
    float z = texelFetch(depth_map, clamp(pixel, ivec2(0), textureSize(depth_map, 0) - 1), 0).r;
    return z > 0.0 ? 1.0 / z : 0.0;
}

float without_spikes(ivec2 pixel) {
    if (any(lessThan(pixel, ivec2(0))) || any(greaterThanEqual(pixel, textureSize(depth_map, 0)))) return 0.0;
    float w = inverse_at(pixel);
    int count = int(jumps(w, inverse_at(pixel + ivec2(1, 0)))) + int(jumps(w, inverse_at(pixel + ivec2(0, 1))))
        + int(jumps(inverse_at(pixel - ivec2(1, 0)), w)) + int(jumps(inverse_at(pixel - ivec2(0, 1)), w));
    return count >= 3 ? 0.0 : w;
}

void fill(ivec2 first) {
    int span = WIDTH + 2 * window_radius + 1;
    for (int i = int(gl_LocalInvocationID.x); i < 2 * span; i += WIDTH) {
        int row = i / span, column = i - row * span;
        inverse_depths[row][column] = without_spikes(first + ivec2(column, row));
    }
    barrier();
}

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    int at = int(gl_LocalInvocationID.x);   // of the window's first pixel
    fill(pixel - ivec2(at + window_radius, 0));
    if (any(greaterThanEqual(pixel, textureSize(depth_map, 0)))) return;
    vec3 moments = vec3(0.0);
    vec2 depth = vec2(0.0);
    bool right = false, down = false;
    for (int i = -window_radius; i <= window_radius; ++i, ++at) {
        float w = inverse_depths[0][at], offset = float(i);
        moments += w > 0.0 ? vec3(1.0, offset, offset * offset) : vec3(0.0);
        depth += w * vec2(1.0, offset);
        right = right || (i < window_radius && jumps(w, inverse_depths[0][at + 1]));
        down = down || jumps(w, inverse_depths[1][at]);
    }
    imageStore(inverse_out, pixel, vec4(inverse_depths[0][int(gl_LocalInvocationID.x) + window_radius]));
    imageStore(row_moments_out, pixel, vec4(moments, float(right) + 2.0 * float(down)));
    imageStore(row_depth_out, pixel, vec4(depth, 0.0, 0.0));
}
