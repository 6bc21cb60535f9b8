// What a volume's objects change of the light beyond it, as two sources (docs/method.md 5.9): of light gained and of light
// lost. A workgroup sums what was injected, cell by cell.
#include "common/basis.glsl"
#include "common/light_cells.glsl"
#include "common/light_sources.glsl"

const int THREADS = 256;   // = local_size_x, a power of two
layout(local_size_x = 256) in;
layout(std430) readonly buffer Change { int change[]; };
layout(std430) readonly buffer Bounced { int bounced[]; };
layout(std430) readonly buffer VirtualCovered { int virtual_covered[]; };
layout(rgba32f) writeonly uniform image2D sources;
uniform int cells;
uniform float cell_edge;     // m
uniform vec3 low_corner;     // world, m
uniform bool has_bounced;
uniform bool has_geometry;
uniform int row;             // the volume's
uniform vec4 arriving;       // fractions that arrive in each volume

const float PER_FLUX = 2.0 * sqrt(PI), PER_VECTOR = sqrt(3.0 * PI);   // of the coefficients of cosine lobes
const float FIXED_POINT_STEPS = 1048576.0;                            // voxel_store.glsl's
const float LEAST_DIRECTED = 0.5;   // of its flux: a cell's light has a side from which it comes

vec4 injected(ivec3 cell, int channel) {
    int at = int(cell_index(cell, cells)) * INJECTED_SUMS + 4 * channel;
    ivec4 sum = ivec4(change[at], change[at + 1], change[at + 2], change[at + 3]);
    if (has_bounced) sum += ivec4(bounced[at], bounced[at + 1], bounced[at + 2], bounced[at + 3]);
    vec4 light = vec4(sum) / INJECTED_STEPS * cell_edge * cell_edge;
    return vec4(light.yzw * PER_VECTOR, light.x * PER_FLUX);
}

float covered(ivec3 cell, int axis) {
    uint at = cell_index(cell, cells) * 6u + uint(2 * axis);
    return float(max(virtual_covered[at], virtual_covered[at + 1u])) / FIXED_POINT_STEPS;
}

// Whether light leaves the objects along its lobe's axis: backs of closed, double-sided bodies light these from inside. Faces
// next to the cell may be covered by the surface that sends the light, if that is tilted, and are not asked.
float open_fraction(ivec3 cell, vec3 towards) {
    vec3 size = abs(towards), stride = towards / max(size.x, max(size.y, size.z)), at = vec3(cell) + 0.5 + 1.5 * stride;
    float blocked = 0.0;
    for (; blocked < 1.0 && in_grid(ivec3(floor(at)), cells); at += stride)
        for (int axis = 0; axis < 3; ++axis) {
            ivec3 face = ivec3(floor(at));
            face[axis] = int(floor(at[axis] + 0.5));
            if (in_grid(face, cells)) blocked += abs(stride[axis]) * covered(face, axis);
        }
    return 1.0 - min(blocked, 1.0);
}

vec4 gained[SOURCE_TEXELS], lost[SOURCE_TEXELS];   // flux of a source's channels (xyz: along the axes, w: all); place, weight

void add(ivec3 cell) {
    vec4 light[3];
    vec4 sum = vec4(0.0);
    for (int channel = 0; channel < 3; ++channel) {
        light[channel] = injected(cell, channel);
        sum += (light[channel].w < 0.0 ? -1.0 : 1.0) * light[channel];
    }
    if (sum.w == 0.0) return;
    float open = has_geometry && length(sum.xyz) > LEAST_DIRECTED * sum.w ? open_fraction(cell, sum.xyz) : 1.0;
    vec4 place = vec4(low_corner + (vec3(cell) + 0.5) * cell_edge, 1.0);
    for (int channel = 0; channel < 3; ++channel) {
        vec4 own = open * light[channel];
        vec4 plus = own.w > 0.0 ? own : vec4(0.0), minus = own - plus;
        gained[channel] += plus;
        lost[channel] += minus;
        gained[3] += plus.w * place;
        lost[3] -= minus.w * place;
    }
}

shared vec4 parts[THREADS];

vec4 sum_of_all(vec4 own, int thread) {
    barrier();
    parts[thread] = own;
    barrier();
    for (int stride = THREADS / 2; stride > 0; stride /= 2) {
        if (thread < stride) parts[thread] += parts[thread + stride];
        barrier();
    }
    return parts[0];
}

void main() {
    int thread = int(gl_LocalInvocationID.x);
    for (int i = 0; i < SOURCE_TEXELS; ++i) gained[i] = lost[i] = vec4(0.0);
    for (int i = thread; i < cells * cells * cells; i += THREADS) add(cell_of_index(uint(i), cells));
    for (int i = 0; i < 2 * SOURCE_TEXELS; ++i) {
        vec4 all = sum_of_all(i < SOURCE_TEXELS ? gained[i] : lost[i - SOURCE_TEXELS], thread);
        if (thread == 0) imageStore(sources, ivec2(i, row), all);
    }
    if (thread == 0) imageStore(sources, ivec2(2 * SOURCE_TEXELS, row), arriving);
}
