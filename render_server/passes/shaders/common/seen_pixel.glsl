// The pixel of the camera's picture that shows a point.
#include "common/camera_image.glsl"
#include "common/lens.glsl"

// Pixel (centres at .5) that shows a point in front of the camera: a pinhole's, displaced by the lens.
vec2 seen_pixel(vec3 c) {
    vec2 pixel = picture_pixel(c), last = picture_size - 1.0;
    for (int i = 0; i < (lens_bends ? 2 : 0); ++i) {
        vec2 ray = texelFetch(picture_rays, ivec2(clamp(pixel, vec2(0.0), last)), 0).xy;
        vec2 centre = floor(clamp(pixel, vec2(0.0), last)) + 0.5;
        pixel = centre + camera_pinhole.xy * (c.xy / c.z - ray);
    }
    return pixel;
}
