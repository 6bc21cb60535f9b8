// Sums up the bounces beyond those that the voxels hold (docs/method.md 4.3). Of each, about the same fraction returns to surfaces and
// is the next one's amount, so all of them add ratio / (1 - ratio) times the next one. Needs bounce_tail.glsl, THREADS.
layout(std430) coherent buffer TailSums { int tail_sums[]; };
layout(rgba16f) writeonly uniform image3D bounce_tail;   // rgb irradiance times area, a: area
#include "common/workgroup_sum.glsl"

// Sums of all of the volume: (amount, returned).
vec2 summed_amounts(int first, int thread) {
    vec2 sum = vec2(0.0);
    for (int place = thread; place < TAIL_PLACES; place += THREADS) {
        int at = (first + place) * TAIL_SUMS;
        sum += vec2(tail_sums[at + TAIL_AMOUNT], tail_sums[at + TAIL_RETURNED]);
    }
    return workgroup_sum(sum, thread);
}

// By a whole workgroup, of one volume, whose sums it leaves empty.
void sum_tail(int number, int thread) {
    int first = number * TAIL_PLACES;
    vec2 amounts = summed_amounts(first, thread);
    float ratio = amounts.y / max(amounts.x, 1.0);   // < 1: no surface reflects all
    vec4 scale = vec4(vec3(ratio / (1.0 - ratio)), 1.0) / TAIL_FIXED_POINT;
    for (int place = thread; place < TAIL_PLACES; place += THREADS) {
        int at = (first + place) * TAIL_SUMS;
        vec4 sums = vec4(tail_sums[at], tail_sums[at + 1], tail_sums[at + 2], tail_sums[at + TAIL_AREA]);
        imageStore(bounce_tail, tail_texel(number, place), sums * scale);
        for (int i = 0; i < TAIL_SUMS; ++i) tail_sums[at + i] = 0;
    }
}
