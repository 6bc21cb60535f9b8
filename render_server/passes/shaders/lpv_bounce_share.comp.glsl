// Which share of a bounce returns with the next one (docs/method.md 5.6): parts of the sums that lpv_add_bounce.comp.glsl finds it from.
#include "common/light_cells.glsl"

const int THREADS = 64;   // = local_size_x
layout(local_size_x = 64) in;
layout(std430) readonly buffer Before { int before[]; };       // sums of the first bounce
layout(std430) readonly buffer Injected { int injected[]; };   // of both
layout(std430) writeonly buffer Parts { vec2 parts[]; };       // of each workgroup: the first bounce and the second, weighted by the second
uniform int cells;
#include "common/workgroup_sum.glsl"

// In luminance and without sign: what one surface gains does not make up for what another loses.
float amount(vec3 flux) { return abs(dot(flux, vec3(0.2126, 0.7152, 0.0722))); }

void main() {
    int count = cells * cells * cells, stride = int(gl_NumWorkGroups.x) * THREADS, thread = int(gl_LocalInvocationID.x);
    vec2 own = vec2(0.0);
    for (int i = int(gl_GlobalInvocationID.x); i < count; i += stride) {
        int at = i * INJECTED_SUMS;
        vec3 first = vec3(before[at], before[at + 4], before[at + 8]);
        float second = amount(vec3(injected[at], injected[at + 4], injected[at + 8]) - first);
        own += second * vec2(amount(first), second);
    }
    vec2 all = workgroup_sum(own, thread);
    if (thread == 0) parts[gl_WorkGroupID.x] = all;
}
