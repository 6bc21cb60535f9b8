// Joint bilateral upsampling from 1/scale of the picture: the 2 x 2 texels around a pixel, weighted by distance and
// by how well their surface continues the pixel's.
#include "common/sample_pixels.glsl"
uniform int scale;
#include "common/continuation.glsl"

// Texel j of the 2 x 2 around `pixel` and its bilinear weight.
ivec2 low_texel(ivec2 pixel, int j, out float weight) {
    vec2 at = (vec2(pixel) + 0.5) / float(scale) - 0.5;
    ivec2 base = ivec2(floor(at));
    vec2 f = at - vec2(base);
    ivec2 o = ivec2(j & 1, j >> 1);
    weight = (o.x == 1 ? f.x : 1.0 - f.x) * (o.y == 1 ? f.y : 1.0 - f.y) + 1e-3;
    return clamp(base + o, ivec2(0), textureSize(sample_pixels, 0) - 1);
}
