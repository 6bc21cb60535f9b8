// Share of each pixel that the virtual objects cover: real surfaces hide them by depth, with an edge softened along
// the picture's own edges. Unknown depth never hides; depth masks the object only, never its delta (METHOD 3).
#include "passes/common/in_front.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
layout(binding = 0, r16f) writeonly uniform image2D matte_out;
layout(binding = 1) uniform sampler2D linear_picture;
layout(binding = 2) uniform sampler2D coverage;   // of samples; r: in front of the real surface, g: behind it, b: g times mean depth
uniform bool antialiased;
uniform vec4 camera_pinhole;   // fx, fy, cx, cy
uniform ivec2 first_pixel;     // of the rectangle that may show an object; the rest was emptied

const int WINDOW = 5;   // pixels
const float STEEPEST = 10.0;   // tangent of the slant (84 degrees) up to which samples of one pixel are taken for one surface

// Share of the pixel's samples that show the surface at depth z, or lie in front. Hidden samples of the same surface
// count: how it passes behind the real one is what the softened edge says.
float covered_share(ivec2 pixel, float z) {
    vec4 c = texelFetch(coverage, pixel, 0);
    if (c.r == 0.0) return c.g;
    bool continues = c.b < c.g * z * (1.0 + STEEPEST / camera_pinhole.x);
    return continues ? c.r + c.g : c.r;
}

// Depth of the object that the pixel shows, 0: none.
float depth_shown(ivec2 pixel) {
    if (antialiased && all(equal(texelFetch(coverage, pixel, 0).rg, vec2(0.0)))) return 0.0;
    ivec2 raster = raster_texel(pixel);
    if (any(lessThan(raster, ivec2(0))) || any(greaterThanEqual(raster, textureSize(virtual_raster_position, 0))))
        return 0.0;
    return texelFetch(virtual_raster_position, raster, 0).w;
}

ivec2 neighbour(ivec2 pixel, int i, ivec2 size) {
    return clamp(pixel + ivec2(i % WINDOW, i / WINDOW) - WINDOW / 2, ivec2(0), size - 1);
}

// Share of the window that is in front, of the pixels that are near and of similar colour.
float softened(ivec2 pixel, float z, ivec2 size) {
    vec3 colour = texelFetch(linear_picture, pixel, 0).rgb;
    float sum = 0.0, weight = 0.0;
    for (int i = 0; i < WINDOW * WINDOW; ++i) {
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
    if (z <= 0.0) { imageStore(matte_out, pixel, vec4(0.0)); return; }
    float share = 0.0;
    for (int i = 0; i < WINDOW * WINDOW; ++i) share += in_front(neighbour(pixel, i, size), z);
    share /= float(WINDOW * WINDOW);
    if (share > 0.0 && share < 1.0) share = softened(pixel, z, size);
    if (antialiased) share *= covered_share(pixel, z);
    imageStore(matte_out, pixel, vec4(share));
}
