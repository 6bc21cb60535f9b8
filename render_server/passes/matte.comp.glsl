// Share of each pixel that the virtual objects cover: real surfaces hide them by depth, with an edge softened along
// the picture's own edges. Unknown depth never hides; depth masks the object only, never its delta (METHOD 3).
// Pixels at such an edge are listed: rims.comp.glsl looks at them again.
#include "passes/common/shown_object.glsl"
#include "passes/common/texel_list.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
layout(binding = 0, r16f) writeonly uniform image2D matte_out;
layout(binding = 1) uniform sampler2D linear_picture;
uniform ivec2 first_pixel;     // of the rectangle that may show an object; the rest was emptied

const int WINDOW = 5;   // pixels

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
    if (share > 0.0 && share < 1.0) {
        share = softened(pixel, z, size);
        append_texel(pixel, size.x);
    }
    if (antialiased) share *= covered_share(pixel, z);
    imageStore(matte_out, pixel, vec4(share));
}
