// Fraction of each pixel that the virtual objects cover: real surfaces occlude them by depth, with an edge softened
// along the picture's own edges. Unknown depth never occludes; depth masks the object only, never its delta
// (docs/method.md 3). Pixels at such an edge are listed for edge_unmixing.comp.glsl.
#include "common/shown_object.glsl"
#define APPENDS_TEXELS
#include "common/work_list.glsl"

#include "common/pixel_group.glsl"
layout(r16f) writeonly uniform image2D object_coverage_out;
uniform sampler2D linear_picture;
#pragma texels rgba16f linear_picture
uniform ivec2 first_pixel;     // of the rectangle that may show an object; the rest was cleared

const int WINDOW = 5;   // pixels

ivec2 neighbour(ivec2 pixel, int i, ivec2 size) {
    return clamp(pixel + ivec2(i % WINDOW, i / WINDOW) - WINDOW / 2, ivec2(0), size - 1);
}

// Fraction of the window in front, over the pixels that are near and of similar colour; if not wanted, any. (llvmpipe executes both
// sides of a branch, but no turn of a loop too many.)
float softened(ivec2 pixel, float z, ivec2 size, bool wanted) {
    vec3 colour = texelFetch(linear_picture, pixel, 0).rgb;
    float sum = 0.0, weight = 0.0;
    int count = wanted ? WINDOW * WINDOW : 0;
    for (int i = 0; i < count; ++i) {
        ivec2 at = neighbour(pixel, i, size);
        vec3 d = (texelFetch(linear_picture, at, 0).rgb - colour) / (0.05 + colour);
        vec2 away = vec2(at - pixel);
        float w = exp(-0.25 * dot(away, away) - 4.0 * dot(d, d));
        sum += w * in_front(at, z);
        weight += w;
    }
    return sum / weight;
}

void main() {
    ivec2 pixel = first_pixel + ivec2(gl_GlobalInvocationID.xy);
    ivec2 size = textureSize(real_surface_position, 0);
    if (any(greaterThanEqual(pixel, size))) return;
    float z = depth_shown(pixel);
    if (z <= 0.0) { imageStore(object_coverage_out, pixel, vec4(0.0)); return; }
    float fraction = 0.0;
    for (int i = 0; i < WINDOW * WINDOW; ++i) fraction += in_front(neighbour(pixel, i, size), z);
    fraction /= float(WINDOW * WINDOW);
    bool at_edge = fraction > 0.0 && fraction < 1.0;
    float smooth_fraction = softened(pixel, z, size, at_edge);
    if (at_edge) {
        fraction = smooth_fraction;
        append_texel(pixel, size.x);
    }
    if (antialiased) fraction *= covered_fraction(pixel, z);
    imageStore(object_coverage_out, pixel, vec4(fraction));
}
