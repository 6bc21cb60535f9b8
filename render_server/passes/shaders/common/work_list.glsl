// A list of texels of the reduced grid: passes walk it instead of branching, because software renderers run both sides
// of a branch, and a GPU keeps its lanes full. What fills the list defines APPENDS_TEXELS.
#include "common/quotient.glsl"
#include "common/walk.glsl"
#ifdef APPENDS_TEXELS
layout(std430) buffer Texels { uint texel_count; uint texels[]; };

void append_texel(ivec2 texel, int grid_width) {
    texels[atomicAdd(texel_count, 1u)] = uint(texel.y * grid_width + texel.x);
}
#else
layout(std430) readonly buffer Texels { uint texel_count; uint texels[]; };

uint listed_count() { return min(texel_count, uint(texels.length())); }
#endif

ivec2 texel_of_index(uint index, int grid_width) {
    int row = quotient(int(index), grid_width);
    return ivec2(int(index) - row * grid_width, row);
}

// Pixel number `inside` of the block of scale x scale pixels that a texel represents.
ivec2 pixel_in_block(ivec2 texel, int inside, int scale) {
    int row = quotient(inside, scale);
    return texel * scale + ivec2(inside - row * scale, row);
}
