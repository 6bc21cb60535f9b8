// Premultiplied (c_k, a_k) texels of level 0 from fixed-point sums: of the real set, with RHO with the change of its light, and of
// the virtual set. With SPENDS, the sums of the change are left empty, and the virtual ones if `spends_virtual`. Needs voxel_store.glsl, SUMS_ACCESS.
#ifdef RHO
#ifdef SPENDS
uniform bool spends_virtual;
layout(std430) buffer DeltaSums { int delta_sums[]; };
layout(std430) buffer VirtualSums { int virtual_sums[]; };
#else
layout(std430) readonly buffer DeltaSums { int delta_sums[]; };
layout(std430) readonly buffer VirtualSums { int virtual_sums[]; };
#endif
layout(std430) readonly buffer VirtualGrid { uint virtual_grid[]; };
#endif

// A voxel face cannot be covered more than once: further layers occlude each other, radiance keeps its mean.
vec4 at_most_covered(vec4 c) { return c.a > 1.0 ? c / c.a : c; }

#ifdef RHO
ivec3 take_delta(int at) {
    ivec3 delta = ivec3(delta_sums[at], delta_sums[at + 1], delta_sums[at + 2]);
#ifdef SPENDS
    delta_sums[at] = delta_sums[at + 1] = delta_sums[at + 2] = 0;
#endif
    return delta;
}
#endif

vec4 real_texel(int slot, int k) {
    int at = slot * SUMS_PER_SLOT;
    ivec3 c = ivec3(sums[at + RADIANCE + k * 3], sums[at + RADIANCE + k * 3 + 1], sums[at + RADIANCE + k * 3 + 2]);
#ifdef RHO
    c += take_delta(slot * 18 + k * 3);
#endif
    return at_most_covered(vec4(vec3(c), float(sums[at + COVERAGE + k])) / FIXED_POINT);
}

#ifdef RHO
vec4 virtual_texel(int slot, int k) {
    int covered = slot * SUMS_PER_SLOT + COVERAGE + k, at = slot * SUMS_PER_SLOT + RADIANCE + k * 3;
    vec4 sum = vec4(virtual_sums[at], virtual_sums[at + 1], virtual_sums[at + 2], virtual_sums[covered]);
#ifdef SPENDS
    if (spends_virtual) virtual_sums[at] = virtual_sums[at + 1] = virtual_sums[at + 2] = virtual_sums[covered] = 0;
#endif
    return at_most_covered(sum / FIXED_POINT);
}
#endif

#ifdef RHO
// Of both sets; `other`: the virtual one's slot + 1, or 0.
vec4 joint_texel(int slot, uint other, int k) {
    vec4 c = real_texel(slot, k);
    return other == 0u ? c : at_most_covered(c + virtual_texel(int(other - 1u), k));
}
#endif
