// Running mean of the linear picture. A block that changed (changed_blocks.comp.glsl) starts anew with the newest picture, and so do those
// around it, where what moves may have changed less than noise hides: it leaves no trail.
#include "common/pixel_group.glsl"
layout(rgba16f) uniform image2D mean;   // rgb; a: how many pictures it is of
uniform sampler2D linear_picture;
uniform usampler2D changed;
#pragma texels rgba16f linear_picture
#pragma texels r8ui changed
uniform ivec4 blocks;      // first column and row, width and height
uniform float longest;     // greatest number of pictures that a mean is of

bool starts_anew(ivec2 block) {
    for (int i = 0; i < 9; ++i) {
        ivec2 at = clamp(block + ivec2(i % 3, i / 3) - 1, blocks.xy, blocks.xy + blocks.zw - 1);
        if (texelFetch(changed, at, 0).r != 0u) return true;
    }
    return false;
}

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, BLOCK * blocks.zw))) return;
    pixel += BLOCK * blocks.xy;
    if (any(greaterThanEqual(pixel, imageSize(mean)))) return;
    vec3 newest = texelFetch(linear_picture, pixel, 0).rgb;
    vec4 kept = imageLoad(mean, pixel);
    float n = starts_anew(pixel / BLOCK) ? 1.0 : min(kept.a + 1.0, longest);
    imageStore(mean, pixel, vec4(n > 1.0 ? mix(kept.rgb, newest, 1.0 / n) : newest, n));
}
