// Which workgroup of a dispatch, or of a part of it, is the last one to end: it can go on with what all of them stored.
layout(std430) coherent buffer GroupsDone { uint groups_done[]; };   // of each part; 0 between dispatches
shared bool is_last;

// Whether all other workgroups of the part are done. Each invocation made its stores visible to all workgroups (what they store to
// is coherent) before the first one counted its workgroup; whoever reads the last count and then passes the barrier sees them all.
bool ends_part(int part, uint group_count) {
    memoryBarrier();
    barrier();
    if (gl_LocalInvocationIndex == 0u) {
        is_last = atomicAdd(groups_done[part], 1u) + 1u == group_count;
        if (is_last) groups_done[part] = 0u;   // nobody else counts here any more
    }
    memoryBarrier();
    barrier();
    return is_last;
}
