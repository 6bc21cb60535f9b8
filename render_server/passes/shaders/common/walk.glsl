// Work spread over a processor's cores. Mesa's software renderer gives each core one run of consecutive workgroups, and work
// lies close together: many lists are shorter than there are threads, many pictures are busy in one half. So CORES groups
// in a row, one of each run, take places in a row. On a GPU CORES is 1, and each group takes its own.
#ifndef CORES
#define CORES 1u
#endif

uint spread(uint group, uint count) {
    uint run = count / CORES;
    return run > 0u && group < run * CORES ? group % run * CORES + group / run : group;
}

// A grid-stride loop: all threads, 64 a workgroup, walk a list together: for (uint i = first_item(); i < count; i += items_apart()).
// Where a step is costly the loop tests at its end, do .. while: software renderers run the step of a loop that tests at
// its beginning once more, with all lanes masked.
uint first_item() { return spread(gl_WorkGroupID.x, gl_NumWorkGroups.x) * 64u + gl_LocalInvocationID.x; }

// Place of a workgroup over a picture.
uvec2 spread_place() {
    uvec2 groups = gl_NumWorkGroups.xy;
    uint group = spread(gl_WorkGroupID.y * groups.x + gl_WorkGroupID.x, groups.x * groups.y);
    return uvec2(group % groups.x, group / groups.x);
}

uint items_apart() { return gl_NumWorkGroups.x * 64u; }

const uint GROUPS_IN_ROW = 256u;   // of workgroups that count_groups counted: OpenGL guarantees at most 65535

uint counted_group() { return gl_WorkGroupID.y * GROUPS_IN_ROW + gl_WorkGroupID.x; }
