// Fixed-point sums of split-inject -> level 0 of V_delta and V_rho. The marker of V_eta goes with both: opacity 1 in
// every voxel that real or virtual geometry touches ([P1] 3.2), so that one fetch gives radiance and opacity.
#include "common/volume.glsl"
#define TOUCHED_ACCESS readonly
#include "common/voxel_store.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image3D delta;
layout(rgba16f) writeonly uniform image3D rho;
layout(std430) readonly buffer Light { int light[]; };
layout(std430) readonly buffer OtherGrid { uint other_grid[]; };
layout(std430) readonly buffer OtherLight { int other_light[]; };
uniform bool skip_shared;   // voxels that the other set touched too are written by its own pass

void main() {
    for (uint i = gl_GlobalInvocationID.x; i < slot_count; i += gl_NumWorkGroups.x * 64u) {
        uint voxel = touched[i];
        uint other = other_grid[voxel];
        if (skip_shared && other != 0u) continue;
        int sums[6];
        for (uint j = 0u; j < 6u; ++j) {
            sums[j] = light[i * 6u + j];
            if (other != 0u) sums[j] += other_light[(other - 1u) * 6u + j];
        }
        ivec3 v = voxel_of_index(voxel, volume_size);
        imageStore(delta, v, vec4(vec3(sums[0], sums[1], sums[2]) / FIXED_POINT, 1.0));
        imageStore(rho, v, vec4(vec3(sums[3], sums[4], sums[5]) / FIXED_POINT, 1.0));
    }
}
