// Radiance of split-inject -> level 0 of V_delta and V_rho: of what a voxel holds of both sets, by area. The marker of V_eta goes with both: opacity 1 in
// every voxel that real or virtual geometry touches ([P1] 3.2), so that one fetch gives radiance and opacity.
#include "common/volume.glsl"
#include "common/walk.glsl"
#define GRID_ACCESS readonly
#define TOUCHED_ACCESS readonly
#include "common/voxel_store.glsl"
#include "common/split_sums.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image3D delta;
layout(rgba16f) writeonly uniform image3D rho;
layout(std430) readonly buffer Light { int light[]; };
layout(std430) readonly buffer VirtualGrid { uint virtual_grid[]; };
layout(std430) readonly buffer VirtualTouched { uint virtual_count; uint virtual_touched[]; };
layout(std430) readonly buffer VirtualLight { int virtual_light[]; };

void store(uint voxel, float found[AREA]) {
    ivec3 v = enter_volume_of(voxel, volume_size);
    imageStore(delta, level_base(0, 0) + v, vec4(found[0], found[1], found[2], 1.0));
    imageStore(rho, level_base(0, 0) + v, vec4(found[3], found[4], found[5], 1.0));
}

// A voxel of the real set, perhaps with what the virtual one holds there.
void resolve(uint voxel, uint slot) {
    uint other = virtual_grid[voxel], at = slot * uint(LIGHT_SUMS), j = (other - 1u) * uint(LIGHT_SUMS);
    float own_area = float(light[at + uint(ALL_AREA)]);
    float other_area = other == 0u ? 0.0 : float(virtual_light[j + uint(ALL_AREA)]);
    float fraction = other_area / max(own_area + other_area, 1.0);
    float found[AREA];
    for (int k = 0; k < AREA; ++k) {
        float own = float(light[at + uint(ALL_DELTA + k)]);
        found[k] = (fraction > 0.0 ? mix(own, float(virtual_light[j + uint(ALL_DELTA + k)]), fraction) : own) / FIXED_POINT;
    }
    store(voxel, found);
}

void resolve_virtual(uint voxel, uint slot) {
    float found[AREA];
    for (int k = 0; k < AREA; ++k)
        found[k] = float(virtual_light[slot * uint(LIGHT_SUMS) + uint(ALL_DELTA + k)]) / FIXED_POINT;
    store(voxel, found);
}

void main() {
    for (uint i = first_item(); i < slot_count; i += items_apart()) resolve(touched[i], i);
    for (uint i = first_item(); i < virtual_count; i += items_apart())
        if (grid[virtual_touched[i]] == 0u) resolve_virtual(virtual_touched[i], i);
}
