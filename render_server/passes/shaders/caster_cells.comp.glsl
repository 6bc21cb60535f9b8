// Which cells of CELL x CELL texels of the light views' depth maps show anything: 0 those, FAR the others.
#include "common/pixel_group.glsl"
layout(r32f) writeonly uniform image2D cells_out;
uniform sampler2D depth_map;
uniform int tile_size;    // texels an edge
uniform int tile_cells;   // cells an edge
const float FAR = 1e9;

void main() {
    ivec2 cell = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(cell, imageSize(cells_out)))) return;
    ivec2 tile = cell / tile_cells, low = (cell - tile * tile_cells) * CELL;
    ivec2 count = min(ivec2(CELL), tile_size - low);
    float nearest = 1.0;
    for (int y = 0; y < count.y; ++y)
        for (int x = 0; x < count.x; ++x)
            nearest = min(nearest, texelFetch(depth_map, tile * tile_size + low + ivec2(x, y), 0).r);
    imageStore(cells_out, cell, vec4(nearest < 1.0 ? 0.0 : FAR));
}
