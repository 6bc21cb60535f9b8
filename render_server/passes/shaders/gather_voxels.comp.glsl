// Irradiance of each group of surfels by a few cones through one mipmap (docs/method.md 4.3, further bounces): the light of
// other surfaces, and of the environment where nothing is in front of it. CHANGE: E_rho from E_mu, by the cones that may meet the
// objects' changes. TAIL: what one more such gathering would add, for some groups of each cell of bounce_tail.glsl; FUSED: the last
// workgroup to end sums that up.
#if !defined(CHANGE) && !defined(TAIL)
#define KEEPS_COVERAGE
#endif
#define TWO_SIDED_STARTS
#include "common/march.glsl"
#include "common/walk.glsl"
#include "common/environment.glsl"
#include "common/diffuse_cones.glsl"
#include "common/voxel_store.glsl"
#define GROUP_ENTRIES_ACCESS readonly
#ifdef TAIL
#define GROUP_SUMS_ACCESS
#else
#define GROUP_SUMS_ACCESS readonly
#endif
#define GROUP_LIGHT_ACCESS
#include "common/surfel_groups.glsl"
#include "common/albedo_range.glsl"

layout(local_size_x = 64) in;
uniform bool only_unseen;    // groups with surfels that the camera does not see
uniform bool keeps_mu;       // writes E_rho alone

// Cones that fill the hemisphere with so few would sample cells as wide as the walls of a small room, and light would
// leak past its edges: 2..10 % in a closed box, below 1 % at a third of the width. What single groups then miss
// between their cones, others see, because each block rotates them by another angle.
const float WIDTH = 0.35;
const vec3 TURN_OF_BLOCK = vec3(0.8191725, 0.6710436, 0.5497005);   // of a full rotation: spread evenly over neighbours

vec3 sums_at(int at) { return vec3(group_sums[at], group_sums[at + 1], group_sums[at + 2]); }

#ifdef TAIL
#include "common/bounce_tail.glsl"
#ifdef FUSED
const int THREADS = 64;   // = local_size_x
#include "common/tail_sums.glsl"
#include "common/last_group.glsl"
#else
layout(std430) buffer TailSums { int tail_sums[]; };
#endif
const int SAMPLED = 2;   // groups along each side of a cell

// Groups on a lattice across their main axis stand for all: what is summed is smooth.
bool is_sampled(uint slot) {
    uint entry = group_entries[slot];
    int axis = int(entry % 6u) / 2, apart = max(volume_size / (2 * TAIL_CELLS * SAMPLED), 1);
    ivec3 block = ivec3(block_corner(entry)) / 2;
    return block[(axis + 1) % 3] % apart == 0 && block[(axis + 2) % 3] % apart == 0;
}

// Albedo of a group (luminance), by sums of light_voxels that begin anew.
float take_albedo(int slot) {
    int at = slot * GROUP_SUMS, radiance = group_sums[at + GROUP_RADIANCE], irradiance = group_sums[at + GROUP_IRRADIANCE];
    group_sums[at + GROUP_RADIANCE] = group_sums[at + GROUP_IRRADIANCE] = 0;
    return min(PI * float(radiance) / float(max(irradiance, 1)), ALBEDO_RANGE.y);
}

// `next`: what one more bounce adds to a group's irradiance; `returned`: which fraction comes back to surfaces.
void add_to_tail(vec3 corner, int k, float area, vec3 next, float returned) {
    float edge = float(volume_size) / float(TAIL_CELLS), amount = dot(abs(next), LUMINANCE);
    float values[TAIL_SUMS] = float[](next.r, next.g, next.b, 1.0, amount, amount * returned);
    float weight = area / (FIXED_POINT * edge * edge) * TAIL_FIXED_POINT;
    int at = TAIL_SUMS * (volume * TAIL_PLACES + tail_place(ivec3(corner / edge), k));
    for (int j = 0; j < TAIL_SUMS; ++j) atomicAdd(tail_sums[at + j], int(round(weight * values[j])));
}
#else
bool is_sampled(uint slot) { return true; }
#endif

void clear_light(int slot) {
#ifndef TAIL
    if (!keeps_mu) group_light[2 * slot] = vec4(0.0);
    group_light[2 * slot + 1] = vec4(0.0);
#endif
}

void gather(int slot) {
    int at = slot * GROUP_SUMS;
    if (only_unseen && group_sums[at + GROUP_UNSEEN] == 0) return;
    // Fixed-point sums of slivers may round to zero: such a group reflects nothing either.
    float area = max(float(group_sums[at + GROUP_AREA]), 1.0);
    vec3 sum = sums_at(at + GROUP_NORMAL);
    if (sum == vec3(0.0)) {
        clear_light(slot);
        return;
    }
    vec3 n = normalize(sum);
    vec3 corner = block_corner(group_entries[slot]);
    vec3 q = corner + sums_at(at + GROUP_PLACE) / area;
    start_on(n, group_sums[at + GROUP_TWO_SIDED] > 0);
    float turn = 2.0 * PI * fract(dot(0.5 * corner, TURN_OF_BLOCK));
    ConeSet cones = ConeSet(1, 0, WIDTH, turn);
#ifdef TAIL
    vec4 mu = group_light[2 * slot];
    vec3 next = mu.rgb + diffuse_change(q, n, cones) - group_light[2 * slot + 1].rgb;
    add_to_tail(corner, main_axis(n), area, next, mu.a * take_albedo(slot));
#elif defined(CHANGE)
    group_light[2 * slot + 1] = vec4(group_light[2 * slot].rgb + diffuse_change(q, n, cones), 0.0);
#else
    vec3 e_mu, e_rho;
    diffuse(q, n, cones, true, e_mu, e_rho);
    if (!keeps_mu) group_light[2 * slot] = vec4(e_mu, near_coverage);
    group_light[2 * slot + 1] = vec4(e_rho, 0.0);
#endif
}

// Lanes of a processor look for groups in a loop of their own, and gather together.
bool find_group(inout uint i, uint count) {
    bool found = false;
    if (i < count) do {
        found = is_sampled(i);
        if (!found) i += items_apart();
    } while (i < count && !found);
    return found;
}

void main() {
    uint count = groups_held(), i = first_item();
    if (find_group(i, count)) do {
        gather(int(i));
        i += items_apart();
    } while (find_group(i, count));
#ifdef FUSED
    if (ends_part(0, gl_NumWorkGroups.x))
        for (int number = 0; number < volume_count; ++number) {
            sum_tail(number, int(gl_LocalInvocationID.x));
            barrier();   // before the next volume's sums share their memory
        }
#endif
}
