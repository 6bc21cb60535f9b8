// Irradiance of each group of surfels by a few cones through one mipmap (docs/method.md 4.3, further bounces): the light of
// other surfaces, and of the environment where nothing is in front of it. CHANGE: E_rho from E_mu, by the cones that may meet the
// objects' changes.
#include "common/march.glsl"
#include "common/walk.glsl"
#include "common/environment.glsl"
#include "common/diffuse_cones.glsl"
#include "common/voxel_store.glsl"
#define GROUP_ENTRIES_ACCESS readonly
#define GROUP_SUMS_ACCESS readonly
#define GROUP_LIGHT_ACCESS
#include "common/surfel_groups.glsl"

layout(local_size_x = 64) in;
uniform bool only_unseen;    // groups with surfels that the camera does not see
uniform bool keeps_mu;       // writes E_rho alone

// Cones that fill the hemisphere with so few would sample cells as wide as the walls of a small room, and light would
// leak past its edges: 2..10 % in a closed box, below 1 % at a third of the width. What single groups then miss
// between their cones, others see, because each block rotates them by another angle.
const float WIDTH = 0.35;
const vec3 TURN_OF_BLOCK = vec3(0.8191725, 0.6710436, 0.5497005);   // of a full rotation: spread evenly over neighbours

vec3 sums_at(int at) { return vec3(group_sums[at], group_sums[at + 1], group_sums[at + 2]); }

void gather(int slot) {
    int at = slot * GROUP_SUMS;
    if (only_unseen && group_sums[at + GROUP_UNSEEN] == 0) return;
    // Fixed-point sums of slivers may round to zero: such a group reflects nothing either.
    float area = max(float(group_sums[at + GROUP_AREA]), 1.0);
    vec3 sum = sums_at(at + GROUP_NORMAL);
    if (sum == vec3(0.0)) {
        if (!keeps_mu) group_light[2 * slot] = vec4(0.0);
        group_light[2 * slot + 1] = vec4(0.0);
        return;
    }
    vec3 n = normalize(sum);
    vec3 corner = block_corner(group_entries[slot]);
    vec3 q = corner + sums_at(at + GROUP_PLACE) / area;
    float turn = 2.0 * PI * fract(dot(0.5 * corner, TURN_OF_BLOCK));
    ConeSet cones = ConeSet(1, 0, WIDTH, turn);
#ifdef CHANGE
    vec3 e_rho = group_light[2 * slot].rgb + diffuse_change(q, n, cones);
#else
    vec3 e_mu, e_rho;
    diffuse(q, n, cones, true, e_mu, e_rho);
    if (!keeps_mu) group_light[2 * slot] = vec4(e_mu, 0.0);
#endif
    group_light[2 * slot + 1] = vec4(e_rho, 0.0);
}

void main() {
    uint count = groups_held(), i = first_item();
    if (i < count) do gather(int(i)); while ((i += items_apart()) < count);
}
