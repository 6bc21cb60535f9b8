// Find the groups of surfels. Without SUM: give each a slot. SUM: add its area, mean normal and place.
#define SURFELS_ACCESS readonly
#define GROUP_GRID_ACCESS
#define GROUP_ENTRIES_ACCESS
#define GROUP_SUMS_ACCESS
#include "common/volume.glsl"
#include "common/walk.glsl"
#include "common/voxel_store.glsl"
#include "common/surfel_groups.glsl"
#ifndef SUM
#include "common/find_group.glsl"
#else
#define SURFEL_LIGHTS_ACCESS readonly
#include "common/surfel_light.glsl"
#endif

layout(local_size_x = 64) in;

#ifdef SUM
uniform bool has_seen;    // SurfelLights marks the surfels that the camera sees

void add_to_group(Surfel s, uint surfel, int side, vec3 n) {
    uint entry = group_entry(floatBitsToUint(s.uv_voxel.z), n);
    int slot = group_slot(entry);
    if (slot < 0) return;
    vec3 corner = block_corner(entry), place = volume_coordinate(s.position_area.xyz) - corner;
    float weight = s.position_area.w / (voxel_edge * voxel_edge);
    int at = slot * GROUP_SUMS;
    atomicAdd(group_sums[at + GROUP_AREA], fixed_point(weight));
    for (int j = 0; j < 3; ++j) {
        atomicAdd(group_sums[at + GROUP_NORMAL + j], fixed_point(weight * n[j]));
        atomicAdd(group_sums[at + GROUP_PLACE + j], fixed_point(weight * place[j]));
    }
    if (s.uv_voxel.w > 0.5) atomicAdd(group_sums[at + GROUP_TWO_SIDED], 1);
    if (!has_seen || surfel_light(2u * surfel + uint(side), RADIANCE_MU).w > 0.5) return;
    atomicAdd(group_sums[at + GROUP_UNSEEN], 1);
}
#else
void add_to_group(Surfel s, uint surfel, int side, vec3 n) { find_group(floatBitsToUint(s.uv_voxel.z), n); }
#endif

void main() {
    uint count = surfels_held();
    for (uint i = first_item(); i < count; i += items_apart()) {
        Surfel s = surfels[i];
        add_to_group(s, i, 0, s.normal_material.xyz);
        if (s.uv_voxel.w > 0.5) add_to_group(s, i, 1, -s.normal_material.xyz);
    }
}
