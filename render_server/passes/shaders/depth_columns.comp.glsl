// Change of w by pixel, by least squares over the window of rows around each pixel; whether it is known, and whether the
// window crosses an edge. Offsets count from the pixel itself, so that no large numbers cancel.
#include "common/pixel_group.glsl"
uniform sampler2D inverse_depth;
uniform sampler2D row_moments;   // as depth_rows leaves them
uniform sampler2D row_depth;
uniform int window_radius;
layout(rgba32f) writeonly uniform image2D window_fits_out;   // dw/dx, dw/dy; known; crosses an edge

const float MIN_SUPPORT = 0.01;   // least determinant, relative to a full window's: pixels must not be few or in a line

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy), size = textureSize(inverse_depth, 0);
    if (any(greaterThanEqual(pixel, size))) return;
    vec3 sums = vec3(0.0), w = vec3(0.0), squares = vec3(0.0);   // 1, u, v;  w, wu, wv;  uu, vv, uv
    bool crosses = false;
    int low = max(-window_radius, -pixel.y), high = min(window_radius, size.y - 1 - pixel.y);
    for (int i = low; i <= high; ++i) {
        vec4 row = texelFetch(row_moments, pixel + ivec2(0, i), 0);
        vec2 depth = texelFetch(row_depth, pixel + ivec2(0, i), 0).rg;
        float v = float(i);
        sums += vec3(row.xy, v * row.x);
        squares += vec3(row.z, v * v * row.x, v * row.y);
        w += vec3(depth, v * depth.x);
        crosses = crosses || mod(row.w, 2.0) > 0.5 || (row.w > 1.5 && i < window_radius);
    }
    vec2 mean = sums.yz / max(sums.x, 1.0);
    squares -= vec3(mean * sums.yz, mean.x * sums.z);
    w.yz -= w.x * mean;
    float edge = float(2 * window_radius + 1), full = edge * edge * float(window_radius * (window_radius + 1)) / 3.0;
    float determinant = squares.x * squares.y - squares.z * squares.z;
    bool known = determinant > MIN_SUPPORT * full * full && texelFetch(inverse_depth, pixel, 0).r > 0.0;
    vec2 slope = vec2(w.y * squares.y - w.z * squares.z, w.z * squares.x - w.y * squares.z) / (known ? determinant : 1.0);
    imageStore(window_fits_out, pixel, vec4(slope, float(known), float(crosses)));
}
