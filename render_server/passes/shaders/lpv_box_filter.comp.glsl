// Mean of a volume's light over cubes of 2 radius + 1 cells an edge ([P2] 7); beyond the border there is no light.
#include "common/light_cells.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
uniform sampler3D total;
layout(rgba32f) writeonly uniform image3D filtered;
uniform int cells;
uniform int radius;

void main() {
    ivec3 cell = ivec3(gl_GlobalInvocationID.xy, int(gl_GlobalInvocationID.z) % cells);
    int channel = int(gl_GlobalInvocationID.z) / cells;
    if (!in_grid(cell, cells) || channel > 2) return;
    ivec3 low = max(cell - radius, ivec3(0)), high = min(cell + radius, ivec3(cells - 1));
    vec4 sum = vec4(0.0);
    for (int z = low.z; z <= high.z; ++z)
        for (int y = low.y; y <= high.y; ++y)
            for (int x = low.x; x <= high.x; ++x) sum += texelFetch(total, in_channel(ivec3(x, y, z), channel, cells), 0);
    float edge = float(2 * radius + 1);
    imageStore(filtered, in_channel(cell, channel, cells), sum / (edge * edge * edge));
}
