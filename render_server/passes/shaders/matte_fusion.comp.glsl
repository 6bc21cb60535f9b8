// Makes mattes of what matting.comp.glsl found. Noise and the choice of samples differ from pixel to pixel, so fractions of
// pixels nearby are averaged, by the inverse of their variance. What a difference of colour makes of the fraction is
// part of that: pixels whose fractions are well known stay by themselves.
#include "common/edge_sides.glsl"
#include "common/work_list.glsl"

layout(local_size_x = 64) in;
uniform ivec4 rectangle;       // in which there are estimates: first column and row, width and height
uniform sampler2D estimate;    // as matting.comp.glsl writes them
uniform sampler2D contrast;
#pragma texels rgba16f estimate contrast

const int REACH = 2;           // pixels
const float ALIKE = 48.0 * NOISE;   // square of a difference of colours, at 1/e: two pixels of twice the noise's deviation
const float STEP = 1.0 / 3072.0;    // variance: of a sixteenth, in which fractions are evaluated

// Mean and variance of the thing's fraction.
vec2 fused(ivec2 pixel) {
    vec3 own = texelFetch(linear_picture, pixel, 0).rgb, side_contrast = texelFetch(contrast, pixel, 0).rgb, sum = vec3(0.0);
    float range = max(dot(side_contrast, side_contrast), NOISE);
    ivec2 first = max(pixel - REACH, rectangle.xy), last = min(pixel + REACH, rectangle.xy + rectangle.zw - 1);
    for (int y = first.y; y <= last.y; ++y)
        for (int x = first.x; x <= last.x; ++x) {
            vec3 d = texelFetch(linear_picture, ivec2(x, y), 0).rgb - own;
            vec3 found = texelFetch(estimate, ivec2(x, y), 0).rgb;
            float off = dot(d, d), w = found.z * exp(-off / ALIKE) / (found.y + off / range + STEP);
            sum += w * vec3(found.xy, 1.0);
        }
    return sum.xy / sum.z;
}

void make_matte(ivec2 pixel) {
    vec4 own = texelFetch(estimate, pixel, 0), side = texelFetch(contrast, pixel, 0);
    if (own.z == 0.0) return;
    vec2 found = fused(pixel);
    if (found.y > UNKNOWN) return;   // no better than a guess
    float covered = antialiased ? covered_fraction(pixel, depth_shown(pixel)) : 1.0;
    float known, a = combined_fraction(pixel, covered, settled(found.x, found.y), known);
    store_edge(pixel, covered, a, known, side.rgb, ivec2(own.w, side.w));
}

void main() {
    int width = textureSize(real_surface_position, 0).x;
    for (uint i = first_item(); i < listed_count(); i += items_apart())
        make_matte(texel_of_index(texels[i], width));
}
