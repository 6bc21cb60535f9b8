// A list that all threads, 64 a workgroup, walk together: for (uint i = first_item(); i < count; i += items_apart()).
// Mesa's software renderer gives each core one run of consecutive workgroups, and many lists are shorter than there are
// threads: so CORES groups in a row, one of each run, begin with items in a row. On a GPU CORES is 1, and item i goes to
// thread i.
#ifndef CORES
#define CORES 1u
#endif

// Where a step is costly the loop tests at its end, do .. while: software renderers run the step of a loop that tests at
// its beginning once more, for no lane.
uint first_item() {
    uint run = gl_NumWorkGroups.x / CORES, group = gl_WorkGroupID.x;
    if (run > 0u && group < run * CORES) group = group % run * CORES + group / run;
    return group * 64u + gl_LocalInvocationID.x;
}

uint items_apart() { return gl_NumWorkGroups.x * 64u; }
