// Least known depth (in all components; 0: none is known) over a window of `source`, whose last component is depth:
// first over blocks of pixels, then over neighbouring blocks. A minimum keeps its place in comparisons: what it lies
// behind, all of the window lies behind.
#include "common/pixel_group.glsl"
layout(rgba32f) writeonly uniform image2D nearest_out;
uniform sampler2D source;
uniform ivec4 blocks;   // first column and row, width and height
uniform int stride;     // texels of `source` from one block to the next
uniform ivec2 window;   // first texel, relative to the block's, and number in a row

void main() {
    ivec2 block = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(block, blocks.zw))) return;
    block += blocks.xy;
    ivec2 size = textureSize(source, 0);
    float nearest = 0.0;
    for (int i = 0; i < window.y * window.y; ++i) {
        ivec2 at = block * stride + window.x + ivec2(i % window.y, i / window.y);
        if (any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, size))) continue;
        float depth = texelFetch(source, at, 0).w;
        if (depth > 0.0 && (nearest <= 0.0 || depth < nearest)) nearest = depth;
    }
    imageStore(nearest_out, block, vec4(nearest));
}
