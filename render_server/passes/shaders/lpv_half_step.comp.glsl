// Half a step of propagation, in place: a cell's total is its own light and what enters from its neighbours' totals. Its cells have one
// colour of a chessboard and all of their neighbours the other, so half steps of alternating colours come to the totals of as many
// whole steps (lpv_propagate_plain.comp.glsl), each for half of the work.
#include "common/light_cells.glsl"
#include "common/light_step.glsl"

layout(local_size_x = 16) in;
layout(rgba32f) readonly uniform image3D state;   // its own light
layout(rgba32f) uniform image3D total;
uniform int colour;   // 0, 1

vec4 light_of(ivec3 texel) { return imageLoad(total, texel); }
#include "common/light_neighbours.glsl"

void main() {
    ivec3 cell = ivec3(gl_GlobalInvocationID);
    cell.x = 2 * cell.x + ((cell.y + cell.z + colour) & 1);
    if (!in_grid(cell, cells)) return;
    Neighbours n = neighbours_of(cell);
    for (int channel = 0; channel < 3; ++channel) {
        ivec3 texel = in_channel(cell, channel, cells);
        imageStore(total, texel, imageLoad(state, texel) + entering(cell, n, channel));
    }
}
