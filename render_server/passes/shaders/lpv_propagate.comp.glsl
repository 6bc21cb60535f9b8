// FUSED steps of propagation: each cell gathers the light of its six neighbours through the faces between them, times
// the transmittance of the geometry volume. A workgroup keeps a tile of one colour channel with a border of FUSED
// cells in shared memory. No light enters from outside the volume.
#include "common/light_cells.glsl"
#include "common/light_step.glsl"

layout(local_size_x = 8, local_size_y = 8, local_size_z = 8) in;
layout(rgba32f) readonly uniform image3D state;
layout(rgba32f) writeonly uniform image3D next_state;
layout(rgba32f) uniform image3D total;
uniform usampler3D transmitted;
#pragma texels rg32ui transmitted
uniform int cells;
uniform bool has_geometry;

const int TILE = 8;
const int THREADS = TILE * TILE * TILE;
const int WIDE = TILE + 2 * FUSED;
shared vec4 tile[WIDE * WIDE * WIDE];

int tile_index(ivec3 c) { return (c.z * WIDE + c.y) * WIDE + c.x; }

ivec3 in_cube(int i, int edge) { return ivec3(i % edge, (i / edge) % edge, i / (edge * edge)); }

vec4 gathered(ivec3 c, uvec2 open) {
    vec4 xy = unpackUnorm4x8(open.x), z = unpackUnorm4x8(open.y);
    vec4 sum = xy.x * along_x(tile[tile_index(c - ivec3(1, 0, 0))], 1.0);
    sum += xy.y * along_x(tile[tile_index(c + ivec3(1, 0, 0))], -1.0);
    sum += xy.z * along_y(tile[tile_index(c - ivec3(0, 1, 0))], 1.0);
    sum += xy.w * along_y(tile[tile_index(c + ivec3(0, 1, 0))], -1.0);
    sum += z.x * along_z(tile[tile_index(c - ivec3(0, 0, 1))], 1.0);
    sum += z.y * along_z(tile[tile_index(c + ivec3(0, 0, 1))], -1.0);
    return sum;
}

const int ROUNDS = ((WIDE - 2) * (WIDE - 2) * (WIDE - 2) + THREADS - 1) / THREADS;

void main() {
    int tiles = cells / TILE, thread = int(gl_LocalInvocationIndex);
    int channel = int(gl_WorkGroupID.z) / tiles;
    ivec3 low = ivec3(gl_WorkGroupID.xy, int(gl_WorkGroupID.z) % tiles) * TILE;
    for (int i = thread; i < WIDE * WIDE * WIDE; i += THREADS) {
        ivec3 cell = low + in_cube(i, WIDE) - FUSED;
        tile[i] = in_grid(cell, cells) ? imageLoad(state, in_channel(cell, channel, cells)) : vec4(0.0);
    }
    memoryBarrierShared();
    barrier();
    ivec3 own = ivec3(gl_LocalInvocationID), texel = in_channel(low + own, channel, cells);
    vec4 sum = imageLoad(total, texel), mine = vec4(0.0);
    for (int done = 1; done <= FUSED; ++done) {
        int edge = WIDE - 2 * done;   // the part of the border that is still valid
        vec4 results[ROUNDS];
        for (int j = 0; j < ROUNDS; ++j) {
            int i = thread + j * THREADS;
            ivec3 c = in_cube(min(i, edge * edge * edge - 1), edge) + done, cell = low + c - FUSED;
            bool inside = in_grid(cell, cells);
            uvec2 open = has_geometry && inside ? texelFetch(transmitted, cell, 0).xy : uvec2(0xffffffffu);
            results[j] = inside ? gathered(c, open) : vec4(0.0);
        }
        memoryBarrierShared();
        barrier();
        for (int j = 0; j < ROUNDS; ++j) {
            int i = thread + j * THREADS;
            if (i < edge * edge * edge) tile[tile_index(in_cube(i, edge) + done)] = results[j];
        }
        memoryBarrierShared();
        barrier();
        mine = tile[tile_index(own + FUSED)];
        sum += mine;
    }
    imageStore(total, texel, sum);
    imageStore(next_state, texel, mine);
}
