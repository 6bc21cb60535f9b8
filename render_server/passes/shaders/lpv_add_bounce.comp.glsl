// Adds a bounce to light that is under way: the sums of all bounces, less those before it (FIRST: none).
// TAIL: and the bounces beyond it (docs/method.md 5.6), to the sums as well. Each sends about the same share of the light of the one
// before, so all of them add share / (1 - share) times the last one.
// CLEARS: the sums before it, which have served, for the next bounce.
#include "common/light_cells.glsl"

const int THREADS = 64;   // = local_size_x
layout(local_size_x = 64) in;
#ifdef TAIL
layout(std430) buffer Injected { int injected[]; };
#else
layout(std430) readonly buffer Injected { int injected[]; };
#endif
#ifdef CLEARS
layout(std430) buffer Before { int before[]; };
#else
#ifndef FIRST
layout(std430) readonly buffer Before { int before[]; };
#endif
#endif
layout(rgba32f) uniform image3D state;
layout(rgba32f) uniform image3D total;
uniform int cells;

#ifdef TAIL
#include "common/workgroup_sum.glsl"
const float GREATEST_SHARE = 0.95;   // the brightest albedo, as in surfel_albedo.glsl
layout(std430) readonly buffer Parts { vec2 parts[]; };   // THREADS of them (lpv_bounce_share.comp.glsl)

float measured_share() {
    vec2 amounts = workgroup_sum(parts[gl_LocalInvocationID.x], int(gl_LocalInvocationID.x));
    return min(amounts.y / max(amounts.x, 1.0), GREATEST_SHARE);
}
#endif

int added(int at, float share) {
    int sum = injected[at];
#ifndef FIRST
    sum -= before[at];
#endif
#ifdef TAIL
    int tail = int(round(share / (1.0 - share) * float(sum)));
    injected[at] += tail;
    sum += tail;
#endif
#ifdef CLEARS
    before[at] = 0;
#endif
    return sum;
}

void main() {
    float share = 0.0;
#ifdef TAIL
    share = measured_share();
#endif
    int i = int(gl_GlobalInvocationID.x);
    if (i >= cells * cells * cells) return;
    ivec3 cell = cell_of_index(uint(i), cells);
    for (int channel = 0; channel < 3; ++channel) {
        int first = i * INJECTED_SUMS + 4 * channel;
        vec4 light;
        for (int k = 0; k < 4; ++k) light[k] = float(added(first + k, share)) / INJECTED_STEPS;
        ivec3 texel = in_channel(cell, channel, cells);
        imageStore(state, texel, imageLoad(state, texel) + light);
        imageStore(total, texel, imageLoad(total, texel) + light);
    }
}
