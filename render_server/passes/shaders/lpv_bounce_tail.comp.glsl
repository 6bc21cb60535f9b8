// The bounces beyond those that a light volume propagates (docs/method.md 5.6). Each sends about the same share of the light of the
// one before, so all of them add share / (1 - share) times the last one. MEASURE: parts of the sums that the share comes from.
// Otherwise: adds the rest of the series to the sums of the last one.
#include "common/light_cells.glsl"

const int THREADS = 64;   // = local_size_x
layout(local_size_x = 64) in;
layout(std430) readonly buffer Before { int before[]; };   // sums of all bounces but the last
uniform int cells;
#include "common/workgroup_sum.glsl"

#ifdef MEASURE
layout(std430) readonly buffer Injected { int injected[]; };   // sums of both bounces
layout(std430) writeonly buffer Parts { vec2 parts[]; };       // of each workgroup: the first bounce and the second, weighted by the second

// In luminance and without sign: what one surface gains does not make up for what another loses.
float amount(vec3 flux) { return abs(dot(flux, vec3(0.2126, 0.7152, 0.0722))); }

void main() {
    int count = cells * cells * cells, apart = int(gl_NumWorkGroups.x) * THREADS, thread = int(gl_LocalInvocationID.x);
    vec2 own = vec2(0.0);
    for (int i = int(gl_GlobalInvocationID.x); i < count; i += apart) {
        int at = i * INJECTED_SUMS;
        vec3 first = vec3(before[at], before[at + 4], before[at + 8]);
        float second = amount(vec3(injected[at], injected[at + 4], injected[at + 8]) - first);
        own += second * vec2(amount(first), second);
    }
    vec2 all = workgroup_sum(own, thread);
    if (thread == 0) parts[gl_WorkGroupID.x] = all;
}
#else
const float GREATEST_SHARE = 0.95;   // the brightest albedo, as in surfel_albedo.glsl
layout(std430) buffer Injected { int injected[]; };
layout(std430) readonly buffer Parts { vec2 parts[]; };   // THREADS of them

void main() {
    vec2 amounts = workgroup_sum(parts[gl_LocalInvocationID.x], int(gl_LocalInvocationID.x));
    float share = min(amounts.y / max(amounts.x, 1.0), GREATEST_SHARE);
    int first = int(gl_GlobalInvocationID.x) * INJECTED_SUMS;
    if (first >= cells * cells * cells * INJECTED_SUMS) return;
    for (int at = first; at < first + INJECTED_SUMS; ++at)
        injected[at] += int(round(share / (1.0 - share) * float(injected[at] - before[at])));
}
#endif
