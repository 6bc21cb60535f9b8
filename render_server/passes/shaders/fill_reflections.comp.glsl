// Reflections at the pixels of smooth objects, from those of the quads around that were traced on the same surface.
#include "common/geometry.glsl"
#include "common/continuation.glsl"
#include "common/shown_pixels.glsl"
#include "common/walk.glsl"

layout(local_size_x = 64) in;
uniform sampler2D object_coverage;
uniform sampler2D traced;   // a texel for each quad
#pragma texels rgba16f traced
uniform float pixel_size;   // m at 1 m depth
layout(rgba16f) writeonly uniform image2D reflected;
#include "common/quads.glsl"

const float SIZE = 4.0;   // pixels: scale of deviations from the pixel's plane

vec4 filled(ivec2 pixel) {
    ivec2 raster = raster_texel(pixel);
    vec4 position = texelFetch(virtual_raster_position, raster, 0), normal = texelFetch(virtual_raster_normal, raster, 0);
    vec2 at = (vec2(pixel) - 0.5) / 2.0, f = fract(at);
    vec4 sum = vec4(0.0);
    float total = 0.0;
    for (int j = 0; j < 4; ++j) {
        ivec2 o = ivec2(j & 1, j >> 1), from = first_of_quad(max(ivec2(floor(at)) + o, ivec2(0)));
        if (from.x < 0) continue;
        vec4 sp = texelFetch(virtual_raster_position, raster_texel(from), 0);
        vec4 sn = texelFetch(virtual_raster_normal, raster_texel(from), 0);
        float w = (o.x == 1 ? f.x : 1.0 - f.x) * (o.y == 1 ? f.y : 1.0 - f.y) + 1e-3;
        w *= sn.w == normal.w ? continuation(position.xyz, normal.xyz, sp.xyz, sn.xyz, SIZE * pixel_size * position.w) + 1e-4 : 0.0;
        sum += w * texelFetch(traced, from / 2, 0);
        total += w;
    }
    return sum / max(total, 1e-6);
}

void main() {
    uint i = first_item();
    if (i < pixels_shown()) do imageStore(reflected, shown_pixel(i), filled(shown_pixel(i))); while ((i += items_apart()) < pixels_shown());
}
