// Gives a surfel's group a slot. Needs surfel_groups.glsl, and all of its blocks but the light.

void find_group(uint voxel, vec3 n) {
    uint entry = group_entry(voxel, n);
    if (atomicCompSwap(group_grid[entry], 0u, 0xffffffffu) != 0u) return;
    uint slot = atomicAdd(group_count, 1u);
    if (slot >= uint(group_entries.length())) return;
    group_entries[slot] = entry;
    atomicExchange(group_grid[entry], slot + 1u);   // others compare and swap it
    for (int i = 0; i < GROUP_SUMS; ++i) group_sums[int(slot) * GROUP_SUMS + i] = 0;
}
