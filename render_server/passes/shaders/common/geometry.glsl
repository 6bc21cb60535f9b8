// Geometry buffers on the picture's pixel grid: the real scene's, and the virtual objects' raster (a slightly wider
// pinhole, sampled through the lens model, so that the picture itself is never resampled).
uniform sampler2D real_surface_position;   // world m; w: depth along the optical axis, 0 unknown
uniform sampler2D real_surface_normal;     // world; w: entry of the surface table, -1 diffuse
uniform sampler2D virtual_raster_position; // world m; w: depth along the optical axis, 0 nothing
uniform sampler2D virtual_raster_normal;   // world; w: material index
uniform sampler2D picture_rays;           // (x/z, y/z) of each pixel
#pragma texels rgba32f real_surface_position virtual_raster_position
#pragma texels rgba16f real_surface_normal virtual_raster_normal
#pragma texels rg32f picture_rays
#include "common/camera.glsl"
#pragma switch bool lens_distortion   // the raster is sampled through the lens model

// Raster texel that a picture pixel sees.
ivec2 raster_texel(ivec2 pixel) {
    if (!lens_distortion) return pixel;
    vec2 ray = texelFetch(picture_rays, pixel, 0).xy;
    return ivec2(floor(raster_pinhole.xy * ray + raster_pinhole.zw + 0.5));
}
