// The objects in a pixel before comparison with real things: their depth and fraction of the pixel.
#include "common/in_front.glsl"
uniform sampler2D sample_coverage;   // of samples; r: in front of the real surface, g: behind it, b: g times mean depth
#pragma texels rgba16f sample_coverage
uniform bool antialiased;
#include "common/camera.glsl"

const float STEEPEST = 10.0;   // tangent of the slant (84 degrees) up to which samples of one pixel count as one surface

// Fraction of the pixel's samples that show the surface at depth z, or are in front. Hidden samples of the same
// surface count: the softened edge decides how it passes behind the real one.
float covered_fraction(ivec2 pixel, float z) {
    vec4 c = texelFetch(sample_coverage, pixel, 0);
    if (c.r == 0.0) return c.g;
    bool continues = c.b < c.g * z * (1.0 + STEEPEST / camera_pinhole.x);
    return continues ? c.r + c.g : c.r;
}

// Depth of the object that the pixel shows, 0: none.
float depth_shown(ivec2 pixel) {
    if (antialiased && all(equal(texelFetch(sample_coverage, pixel, 0).rg, vec2(0.0)))) return 0.0;
    ivec2 raster = raster_texel(pixel);
    if (any(lessThan(raster, ivec2(0))) || any(greaterThanEqual(raster, textureSize(virtual_raster_position, 0))))
        return 0.0;
    return texelFetch(virtual_raster_position, raster, 0).w;
}
