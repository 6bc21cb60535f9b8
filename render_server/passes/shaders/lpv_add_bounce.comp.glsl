// Adds a bounce to light that is under way (common/added_bounce.glsl).
#include "common/light_cells.glsl"
#include "common/added_bounce.glsl"

const int THREADS = 64;   // = local_size_x
layout(local_size_x = 64) in;
layout(rgba32f) uniform image3D state;
layout(rgba32f) uniform image3D total;
uniform int cells;

#ifdef TAIL
#include "common/workgroup_sum.glsl"

float measured_share() { return share_of(workgroup_sum(parts[gl_LocalInvocationID.x], int(gl_LocalInvocationID.x))); }
#endif

void main() {
    float share = 0.0;
#ifdef TAIL
    share = measured_share();
#endif
    int i = int(gl_GlobalInvocationID.x);
    if (i >= cells * cells * cells) return;
    ivec3 cell = cell_of_index(uint(i), cells);
    for (int channel = 0; channel < 3; ++channel) {
        vec4 light = added_light(i, channel, share);
        ivec3 texel = in_channel(cell, channel, cells);
        imageStore(state, texel, imageLoad(state, texel) + light);
        imageStore(total, texel, imageLoad(total, texel) + light);
    }
}
