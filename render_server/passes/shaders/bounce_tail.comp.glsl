// Sums up the bounces beyond those that the voxels hold (docs/method.md 4.3). Each adds less than the one before by about the same
// ratio, so all of them add ratio / (1 - ratio) times the next one. A workgroup for each volume, which leaves the sums empty.
#include "common/bounce_tail.glsl"

layout(local_size_x = 256) in;
layout(std430) buffer TailSums { int tail_sums[]; };
layout(rgba16f) writeonly uniform image3D bounce_tail;   // rgb irradiance times area, a: area
uniform int bounces;   // so far, >= 1
shared vec4 parts[gl_WorkGroupSize.x];

// Sums of all of the volume: amounts, and what returns of both.
vec4 summed_amounts(int first, int thread, int threads) {
    vec4 sum = vec4(0.0);
    for (int place = thread; place < TAIL_PLACES; place += threads) {
        int at = (first + place) * TAIL_SUMS + TAIL_AMOUNTS;
        sum += vec4(tail_sums[at], tail_sums[at + 1], tail_sums[at + 2], tail_sums[at + 3]);
    }
    parts[thread] = sum;
    barrier();
    for (int apart = threads / 2; apart > 0; apart /= 2) {
        if (thread < apart) parts[thread] += parts[thread + apart];
        barrier();
    }
    return parts[0];
}

// Ratio r of bounces that add 1, r .. r^(n - 1) so far and r^n next, of which `share` = r^n / (1 + r + .. + r^(n - 1)) is known.
float ratio_of(float share) {
    float low = 0.0, high = 1.0;
    for (int i = 0; i < 16; ++i) {
        float middle = 0.5 * (low + high), so_far = 0.0, term = 1.0;
        for (int n = 0; n < bounces; ++n) { so_far += term; term *= middle; }
        if (term < share * so_far) low = middle; else high = middle;
    }
    return low;
}

// Ratio of the bounces after the next one. Of a bounce's amount, albedo times coverage would return if objects absorbed nothing;
// less does, by as much as the bounces so far have shown. (They show more where the objects' light was a poor first guess.)
float ratio_ahead(vec4 sums) {
    vec2 returned = sums.zw / max(sums.xy, vec2(1.0));
    return returned.y * min(ratio_of(sums.y / max(sums.x, 1.0)) / max(returned.x, 1e-6), 1.0);
}

void main() {
    int number = int(gl_WorkGroupID.x), thread = int(gl_LocalInvocationID.x), threads = int(gl_WorkGroupSize.x);
    int first = number * TAIL_PLACES;
    float ratio = ratio_ahead(summed_amounts(first, thread, threads));
    vec4 scale = vec4(vec3(ratio / (1.0 - ratio)), 1.0) / TAIL_FIXED_POINT;
    for (int place = thread; place < TAIL_PLACES; place += threads) {
        int at = (first + place) * TAIL_SUMS;
        vec4 sums = vec4(tail_sums[at], tail_sums[at + 1], tail_sums[at + 2], tail_sums[at + TAIL_AREA]);
        imageStore(bounce_tail, tail_texel(number, place), sums * scale);
        for (int i = 0; i < TAIL_SUMS; ++i) tail_sums[at + i] = 0;
    }
}
