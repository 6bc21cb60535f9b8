// Radiance of split-inject -> level 0 of V_delta and V_rho: of what a voxel holds of both sets, by area. The marker of V_eta goes with both: opacity 1 in
// every voxel that real or virtual geometry touches ([P1] 3.2), so that one fetch gives radiance and opacity.
#include "common/volume.glsl"
#include "common/walk.glsl"
#define TOUCHED_ACCESS readonly
#include "common/voxel_store.glsl"
#include "common/split_sums.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image3D delta;
layout(rgba16f) writeonly uniform image3D rho;
layout(std430) readonly buffer Light { int light[]; };
layout(std430) readonly buffer OtherGrid { uint other_grid[]; };
layout(std430) readonly buffer OtherLight { int other_light[]; };
uniform bool skip_shared;   // voxels that the other set touched too are written by its own pass

void main() {
    for (uint i = first_item(); i < slot_count; i += items_apart()) {
        uint voxel = touched[i];
        uint other = other_grid[voxel];
        if (skip_shared && other != 0u) continue;
        float own_area = float(light[i * uint(LIGHT_SUMS) + uint(ALL_AREA)]);
        uint j = (other - 1u) * uint(LIGHT_SUMS);
        float other_area = other == 0u ? 0.0 : float(other_light[j + uint(ALL_AREA)]);
        float share = other_area / max(own_area + other_area, 1.0);
        float found[AREA];
        for (int k = 0; k < AREA; ++k) {
            float own = float(light[i * uint(LIGHT_SUMS) + uint(ALL_DELTA + k)]);
            found[k] = (share > 0.0 ? mix(own, float(other_light[j + uint(ALL_DELTA + k)]), share) : own) / FIXED_POINT;
        }
        ivec3 v = enter_volume_of(voxel, volume_size);
        imageStore(delta, level_base(0, 0) + v, vec4(found[0], found[1], found[2], 1.0));
        imageStore(rho, level_base(0, 0) + v, vec4(found[3], found[4], found[5], 1.0));
    }
}
