// Radiance of split-inject -> level 0 of V_mu: the real set's light as it was without objects. What V_delta takes away where
// an object keeps light off has the other sign there.
#include "common/volume.glsl"
#define TOUCHED_ACCESS readonly
#include "common/voxel_store.glsl"
#include "common/split_sums.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image3D mu;
layout(std430) readonly buffer Light { int light[]; };

void main() {
    for (uint i = gl_GlobalInvocationID.x; i < slot_count; i += gl_NumWorkGroups.x * 64u) {
        int at = int(i) * LIGHT_SUMS;
        vec3 found;
        for (int k = 0; k < 3; ++k) found[k] = float(light[at + ALL_RHO + k] - light[at + ALL_DELTA + k]);
        ivec3 v = enter_volume_of(touched[i], volume_size);
        imageStore(mu, level_base(0, 0) + v, vec4(found / FIXED_POINT, 1.0));
    }
}
