// One axis of the squared distance, in cells, from any point of a cell to the nearest cell that shows anything (separable,
// as in Felzenszwalb and Huttenlocher 2012). Distances are between the cells' borders, so they are never too large.
#include "common/pixel_group.glsl"
layout(r32f) readonly uniform image2D cells;
layout(r32f) writeonly uniform image2D cells_out;
uniform int tile_cells;   // an edge
uniform ivec2 axis;       // (1, 0) or (0, 1)

void main() {
    ivec2 cell = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(cell, imageSize(cells_out)))) return;
    int place = (cell.x * axis.x + cell.y * axis.y) % tile_cells;
    ivec2 first = cell - place * axis;
    float least = 1e9;
    for (int i = 0; i < tile_cells; ++i) {
        float gap = max(abs(float(i - place)) - 1.0, 0.0);
        least = min(least, imageLoad(cells, first + i * axis).r + gap * gap);
    }
    imageStore(cells_out, cell, vec4(least));
}
