// Sampling pattern of a pixel's few rays: RAY_COUNT numbered samples of a lobe and of the pixel.
#include "common/interleaved_gradient_noise.glsl"

// Ray j of RAY_COUNT: xy over the lobe, zw within the pixel. Each represents an equal fraction of the lobe's energy,
// at its middle, so that no pixel has a longer tail than its neighbour; the pattern is rotated from pixel to pixel,
// the same in each frame.
vec4 ray_numbers(ivec2 pixel, int j) {
    vec3 even = float(j) * vec3(0.6180339887, 0.7548776662, 0.5698402910);   // golden ratio; Roberts 2018
    vec2 turn = vec2(interleaved_gradient_noise(vec2(pixel)), interleaved_gradient_noise(vec2(pixel.yx) + 47.0));
    return vec4(fract(even.x + turn.x), (float(j) + 0.5) / float(RAY_COUNT), fract(even.yz + turn.yx));
}
