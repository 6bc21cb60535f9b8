// For each texel of the reduced grid, the picture pixel nearest to its centre that shows a real surface with depth,
// and the one that shows a virtual object. Where objects hide all real surfaces, one of these as -2 - pixel.
#include "common/geometry.glsl"
#define APPENDS_TEXELS
#include "common/work_list.glsl"
#define APPENDS_PIXELS
#include "common/shown_pixels.glsl"

#include "common/pixel_group.glsl"
layout(rgba16i) writeonly uniform iimage2D sample_pixels_out;
uniform sampler2D object_coverage;
#pragma texels r16f object_coverage
uniform ivec2 picture_pixels;
uniform int scale;

#ifdef QUADS
// Of each quad in the texels that show an object, the pixel that stands for it; as ShownPixels.
layout(std430) buffer Quads { uint quad_count; uint quad_pixels[]; };
#include "common/quads.glsl"

void append_quads(ivec2 texel) {
    int edge = (scale + 1) / 2;
    for (int i = 0; i < edge * edge; ++i) {
        ivec2 pixel = first_of_quad(texel * scale / 2 + ivec2(i % edge, i / edge));
        if (pixel.x >= 0) quad_pixels[atomicAdd(quad_count, 1u)] = packed_pixel(pixel);
    }
}
#endif

// Lists the `count` pixels of a texel that show an object.
void append_shown(ivec2 texel, uint count) {
    uint place = count > 0u ? room_for_pixels(count) : 0u;
    for (int i = 0; i < (count > 0u ? scale * scale : 0); ++i) {
        ivec2 pixel = pixel_in_block(texel, i, scale);
        if (all(lessThan(pixel, picture_pixels)) && texelFetch(object_coverage, pixel, 0).r > 0.0)
            put_pixel(place++, pixel);
    }
}

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    ivec2 low = (picture_pixels + scale - 1) / scale;
    if (any(greaterThanEqual(texel, low))) return;
    ivec4 best = ivec4(-1);
    ivec2 hidden = ivec2(-1);
    vec3 nearest = vec3(1e9);
    uint shown_here = 0u;
    for (int j = 0; j < scale; ++j)
        for (int i = 0; i < scale; ++i) {
            ivec2 pixel = texel * scale + ivec2(i, j);
            if (any(greaterThanEqual(pixel, picture_pixels))) continue;
            vec2 d = vec2(i, j) - 0.5 * float(scale - 1);
            float away = dot(d, d);
            float shown = texelFetch(object_coverage, pixel, 0).r;
            shown_here += uint(shown > 0.0);
            bool known = texelFetch(real_surface_position, pixel, 0).w > 0.0;
            if (away < nearest.x && shown < 1.0 && known) { nearest.x = away; best.xy = pixel; }
            if (away < nearest.z && shown == 1.0 && known) { nearest.z = away; hidden = -2 - pixel; }
            if (away < nearest.y && shown > 0.0) { nearest.y = away; best.zw = pixel; }
        }
    if (best.x < 0) best.xy = hidden;
    imageStore(sample_pixels_out, texel, best);
    if (best.z >= 0) append_texel(texel, low.x);
#ifdef QUADS
    if (best.z >= 0) append_quads(texel);
#endif
    append_shown(texel, shown_here);
}
