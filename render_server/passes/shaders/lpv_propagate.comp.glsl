// FUSED steps of propagation: each cell gathers the light of its six neighbours through the faces between them, times
// the transmittance of the geometry volume. A workgroup keeps a tile of one colour channel with a border of FUSED
// cells in shared memory. No light enters from outside the volume.
//
// A step takes light from even cells (by the sum of their coordinates) to odd ones and from odd ones to even: two systems that never
// meet. So a workgroup steps one after the other, and holds half of the cells at a time: borders of four fit 32 KB.
//
// HALVES: as many half steps, as in lpv_half_step.comp.glsl, from one total to the next: of one system alone, the cells that change and
// their neighbours in turn.
#include "common/light_cells.glsl"
#include "common/light_step.glsl"

layout(local_size_x = 8, local_size_y = 8, local_size_z = 8) in;
layout(rgba32f) readonly uniform image3D state;
#ifdef HALVES
layout(rgba32f) readonly uniform image3D total;
layout(rgba32f) writeonly uniform image3D next_total;
uniform int colour;   // of the cells that the first half step changes
#define TAKEN total
#else
layout(rgba32f) writeonly uniform image3D next_state;
layout(rgba32f) uniform image3D total;
#define TAKEN state
#endif
uniform usampler3D transmitted;
#pragma texels rg32ui transmitted
uniform int cells;
uniform bool has_geometry;

const int TILE = 8;
const int THREADS = TILE * TILE * TILE;
const int WIDE = TILE + 2 * FUSED;
const int ROUNDS = ((WIDE - 2) * (WIDE - 2) * (WIDE - 2) / 2 + THREADS - 1) / THREADS;
shared vec4 held[WIDE * WIDE * WIDE / 2];   // of the cells of one parity

int parity(ivec3 c) { return (c.x + c.y + c.z) & 1; }

int held_index(ivec3 c) { return ((c.z * WIDE + c.y) * WIDE + c.x) >> 1; }

// Cell number i of those of a parity in a cube at `first`, of an even edge.
ivec3 in_cube(int i, int edge, int first, int wanted) {
    int half_edge = edge / 2, row = i / half_edge;
    ivec3 c = ivec3(2 * (i % half_edge), row % edge, row / edge) + first;
    c.x += parity(c) ^ wanted;
    return c;
}

vec4 gathered(ivec3 c, uvec2 open) {
    vec4 xy = unpackUnorm4x8(open.x), z = unpackUnorm4x8(open.y);
    vec4 sum = xy.x * along_x(held[held_index(c - ivec3(1, 0, 0))], 1.0);
    sum += xy.y * along_x(held[held_index(c + ivec3(1, 0, 0))], -1.0);
    sum += xy.z * along_y(held[held_index(c - ivec3(0, 1, 0))], 1.0);
    sum += xy.w * along_y(held[held_index(c + ivec3(0, 1, 0))], -1.0);
    sum += z.x * along_z(held[held_index(c - ivec3(0, 0, 1))], 1.0);
    sum += z.y * along_z(held[held_index(c + ivec3(0, 0, 1))], -1.0);
    return sum;
}

// Lets the whole workgroup see what each of its invocations stored.
void share() {
    memoryBarrierShared();
    barrier();
}

void load(ivec3 low, int channel, int wanted) {
    for (int i = int(gl_LocalInvocationIndex); i < WIDE * WIDE * WIDE / 2; i += THREADS) {
        ivec3 c = in_cube(i, WIDE, 0, wanted), cell = low + c - FUSED;
        held[held_index(c)] = in_grid(cell, cells) ? imageLoad(TAKEN, in_channel(cell, channel, cells)) : vec4(0.0);
    }
    share();
}

// Light that a cell has by itself.
vec4 own_light(ivec3 cell, int channel) {
#ifdef HALVES
    return imageLoad(state, in_channel(cell, channel, cells));
#else
    return vec4(0.0);
#endif
}

// From cells of one parity to those of the other, `wanted`, in the part of the border that is valid after so many steps.
void step_to(ivec3 low, int channel, int done, int wanted) {
    int edge = WIDE - 2 * done, count = edge * edge * edge / 2;
    vec4 results[ROUNDS];
    for (int j = 0; j < ROUNDS; ++j) {
        int i = int(gl_LocalInvocationIndex) + j * THREADS;
        if (i >= count) continue;
        ivec3 c = in_cube(i, edge, done, wanted), cell = low + c - FUSED;
        bool inside = in_grid(cell, cells);
        uvec2 open = has_geometry && inside ? texelFetch(transmitted, cell, 0).xy : uvec2(0xffffffffu);
        results[j] = inside ? own_light(cell, channel) + gathered(c, open) : vec4(0.0);
    }
    share();
    for (int j = 0; j < ROUNDS; ++j) {
        int i = int(gl_LocalInvocationIndex) + j * THREADS;
        if (i < count) held[held_index(in_cube(i, edge, done, wanted))] = results[j];
    }
    share();
}

#ifdef HALVES
void run_steps(ivec3 low, int channel, ivec3 own) {
    ivec3 texel = in_channel(low + own - FUSED, channel, cells);
    int first = (colour + FUSED) & 1;   // parity in the tile, whose border shifts it
    vec4 after = imageLoad(total, texel);
    load(low, channel, 1 - first);
    for (int done = 1; done <= FUSED; ++done) {
        int reached = (first + done - 1) & 1;
        step_to(low, channel, done, reached);
        if (parity(own) == reached) after = held[held_index(own)];
    }
    imageStore(next_total, texel, after);
}
#else
void run_steps(ivec3 low, int channel, ivec3 own) {
    vec4 after[FUSED];   // each step
    for (int first = 0; first < 2; ++first) {
        load(low, channel, first);
        for (int done = 1; done <= FUSED; ++done) {
            int reached = (first + done) & 1;
            step_to(low, channel, done, reached);
            if (parity(own) == reached) after[done - 1] = held[held_index(own)];
        }
        share();   // before the next system takes its place
    }
    ivec3 texel = in_channel(low + own - FUSED, channel, cells);
    vec4 sum = imageLoad(total, texel);
    for (int i = 0; i < FUSED; ++i) sum += after[i];
    imageStore(total, texel, sum);
    imageStore(next_state, texel, after[FUSED - 1]);
}
#endif

void main() {
    int tiles = cells / TILE, channel = int(gl_WorkGroupID.z) / tiles;
    ivec3 low = ivec3(gl_WorkGroupID.xy, int(gl_WorkGroupID.z) % tiles) * TILE;
    run_steps(low, channel, ivec3(gl_LocalInvocationID) + FUSED);
}
