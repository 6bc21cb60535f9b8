// Sums each surfel's opacity and outgoing radiance into its voxel, per direction k (docs/method.md 4.3):
//   a_k += A max(0, -n.k) / h^2,   c_k += L A max(0, -n.k) / h^2.
// REAL: L_mu is the measured radiance (all bounces), or albedo / pi E_mu where the camera does not look;
//       REAL_DELTA sums L_rho - L_mu = L_mu (E_rho / E_mu - 1).
// VIRTUAL: L_rho = albedo / pi E_rho + emission.
// E is direct + ambient light at first; FROM_MU: direct light + what the surfel's group gathered from mu; GATHERED: the direct
// light of either run + what the group gathered, where REAL and VIRTUAL add the growth of L.
// FINDS_GROUPS: each surfel's group gets a slot on the way (group_surfels). MARKS: so does its voxel in a mipmap's occupancy.
// REAL_MU and REAL_RHO sum all of L, each under the maps of its own solution: L_mu as REAL,
// L_rho = L_mu E_rho / E_mu where the camera measured L_mu, albedo / pi E_rho where it does not look.
#define SURFELS_ACCESS readonly
#define SURFEL_LIGHTS_ACCESS
#define KEEPS_SURFEL_LIGHTS
#define GRID_ACCESS readonly
#ifndef REAL_DELTA
#define SUMS_ACCESS
#endif
#include "common/volume.glsl"
#include "common/walk.glsl"
#include "common/voxel_store.glsl"
#include "common/surfel_light.glsl"
#include "common/environment.glsl"
#include "common/brdf.glsl"
#include "common/albedo_range.glsl"
#ifdef VIRTUAL
#pragma switch TRANSMISSION
#endif
#ifdef REAL_DELTA
#pragma switch TRANSMISSION
#endif
#ifndef GATHERED
#include "common/lights.glsl"
#endif
#ifdef VIRTUAL
#include "common/materials.glsl"
#ifdef EXTENDED
#include "common/coating.glsl"
#endif
#endif

layout(local_size_x = 64) in;
uniform float bias_real;      // m
uniform float bias_object;   // m
uniform bool keep_light;      // in SurfelLights, for later sums
uniform bool has_caustics;    // beams carry the lights' reflections in smooth virtual surfaces
#if defined(REAL_MU) || defined(REAL_RHO)
#define SOLUTION
#endif
#if defined(REAL) || defined(SOLUTION)
#include "common/real_radiance.glsl"
#endif
#ifdef REAL_DELTA
layout(std430) buffer DeltaSums { int delta_sums[]; };   // 18 per slot
layout(std430) buffer Support { int support[]; };        // of each volume, bounds of changed voxels: min xyz, -max xyz
#endif

#ifdef FINDS_GROUPS
#define GROUP_GRID_ACCESS
#define GROUP_ENTRIES_ACCESS
#define GROUP_SUMS_ACCESS
#endif
#ifdef GATHERED
#define READS_GROUPS
#endif
#ifdef FROM_MU
#define READS_GROUPS
#endif
#ifdef READS_GROUPS
#define GROUP_GRID_ACCESS readonly
#define GROUP_LIGHT_ACCESS readonly
#if defined(GATHERED) && (defined(REAL_DELTA) || defined(REAL_RHO))
#define GROUP_SUMS_ACCESS
#endif
#endif
#ifdef GROUP_GRID_ACCESS
#include "common/surfel_groups.glsl"

int group_of(Surfel s, vec3 n) { return group_slot(group_entry(floatBitsToUint(s.uv_voxel.z), n)); }
#endif
#ifdef FINDS_GROUPS
#include "common/find_group.glsl"
#else
void find_group(uint voxel, vec3 n) {}
#endif

#ifdef MARKS
#include "common/mark_occupancy.glsl"
#else
void occupy(ivec3 voxel) {}
#endif

#ifdef GATHERED
void irradiances(Surfel s, vec3 n, uint own, out vec3 mu, out vec3 rho) {
    int slot = group_of(s, n);
    vec3 ambient = environment_irradiance(n);
    mu = surfel_light(own, DIRECT_MU).rgb + (slot < 0 ? ambient : group_light[2 * slot].rgb);
    rho = surfel_light(own, DIRECT_RHO).rgb + (slot < 0 ? ambient : group_light[2 * slot + 1].rgb);
}
#else
#ifdef VIRTUAL
const float LIFT = 0.1;       // voxels, so that a curved surface does not shadow its own surfels
#else
const float LIFT = 0.0;
#endif

#if defined(REAL) || defined(SOLUTION)
// Without the objects, whose maps may be those of an earlier frame; a solution's own maps hold all of its geometry.
vec2 light_fraction(Light light, vec3 p, vec3 n) { return vec2(real_visibility(light, p, n, bias_real)); }
#else
vec2 light_fraction(Light light, vec3 p, vec3 n) { return visibility(light, p, n, bias_real, bias_object); }
#endif

void irradiances(Surfel s, vec3 n, uint own, out vec3 mu, out vec3 rho) {
    vec3 p = s.position_area.xyz + n * voxel_edge * LIFT;
    mu = rho = vec3(0.0);
    int i = 0;
    if (light_count > 0) do {   // a loop that tests at its end: lights.glsl
        vec3 to_light; float radius;
        vec3 e_perp = light_at(listed_light(i), p, n, to_light, radius);
        float cosine = dot(n, to_light);
        if (cosine <= 0.0) continue;
        vec2 v = light_fraction(listed_light(i), p, n);
        mu += e_perp * cosine * v.x;
        rho += e_perp * cosine * arriving(listed_light(i), p, v, 0.0);
    } while (++i < light_count);
    if (keep_light) {
#ifndef REAL_RHO
        keep_surfel_light(own, DIRECT_MU, vec4(mu, 0.0));
#endif
        keep_surfel_light(own, DIRECT_RHO, vec4(rho, 0.0));
    }
#ifdef REAL_RHO
    mu = surfel_light(own, DIRECT_MU).rgb;
#endif
    vec3 ambient = environment_irradiance(n);
#ifdef FROM_MU
    int slot = group_of(s, n);
    if (slot >= 0) ambient = group_light[2 * slot].rgb;   // also the first guess of rho's
#endif
    mu += ambient;
    rho += ambient;
}
#endif

// `opaque`: fraction of the surface that lets no light through.
void add(uint voxel, vec3 n, float area, float opaque, vec3 radiance) {
    int slot = int(grid[voxel]) - 1;
    float scale = area / (voxel_edge * voxel_edge);
    for (int axis = 0; axis < 3; ++axis) {
        float facing = abs(n[axis]) * scale;
        int k = 2 * axis + (n[axis] > 0.0 ? 1 : 0);   // the direction along the axis that the surface faces
        if (!(facing > 0.0)) continue;   // nor where it is no number
#ifdef REAL_DELTA
        int at = slot * 18 + k * 3;
        for (int j = 0; j < 3; ++j) atomicAdd(delta_sums[at + j], fixed_point(radiance[j] * facing));
#else
        int at = slot * SUMS_PER_SLOT;
#if !defined(GATHERED) || defined(SOLUTION)
        atomicAdd(sums[at + COVERAGE + k], fixed_point(facing * opaque));
#endif
        for (int j = 0; j < 3; ++j) atomicAdd(sums[at + RADIANCE + k * 3 + j], fixed_point(radiance[j] * facing));
#endif
    }
}

#if !defined(REAL_DELTA) && !defined(SOLUTION)
// Radiance that the sums lack: all of it at first, then what gathered light changes. w: 1 where the camera measured it.
vec3 radiance_to_add(uint own, vec4 radiance) {
#ifdef GATHERED
    vec3 summed = surfel_light(own, RADIANCE_MU).rgb;
#else
    vec3 summed = vec3(0.0);
#endif
    if (keep_light) keep_surfel_light(own, RADIANCE_MU, radiance);
    return radiance.rgb - summed;
}
#endif

#ifdef VIRTUAL
vec3 outgoing(Surfel s, vec3 n, uint own) {
    vec3 mu, rho;
    irradiances(s, n, own, mu, rho);
    Material m = material_of(int(s.normal_material.w), s.uv_voxel.xy, s.tint.rgb, sqrt(s.position_area.w));
    vec3 diffuse = mean_diffuse_reflectance(m.diffuse, m.f0, m.roughness);
    vec3 albedo = min(diffuse + mean_specular_reflectance(m.f0, m.roughness), vec3(ALBEDO_RANGE.y));
    bool in_beams = has_caustics && keep_light && m.roughness * m.roughness < GREATEST_ALPHA;
    vec3 carried = in_beams ? (albedo - min(diffuse, albedo)) * surfel_light(own, DIRECT_RHO).rgb : vec3(0.0);
#ifdef EXTENDED
    float below = mean_below(m.over);   // beams carry the base's lobe alone
    albedo = min(mean_coated_reflectance(m, albedo), vec3(ALBEDO_RANGE.y));
    carried *= below;
    m.emission *= below;
#endif
    return radiance_to_add(own, vec4((albedo * rho - carried) / PI + m.emission, 0.0));
}
#endif

#ifdef REAL
vec3 outgoing(Surfel s, vec3 n, uint own) {
#ifdef GATHERED
    if (surfel_light(own, RADIANCE_MU).w > 0.5) return vec3(0.0);
#else
    vec3 p = s.position_area.xyz;
    if (camera_sees(p, n)) return radiance_to_add(own, vec4(measured_radiance(p), 1.0));
#endif
    vec3 mu, rho;
    irradiances(s, n, own, mu, rho);
    return radiance_to_add(own, vec4(unseen_albedo(s.position_area.xyz) / PI * mu, 0.0));
}
#endif

#if defined(REAL_DELTA) || defined(REAL_RHO)
// Additional radiance under rho of a surface with reflectance `back`. A ratio is right whatever the light's scale;
// gained light is reflected by at most the greatest albedo.
vec3 change_of(vec3 back, vec3 mu, vec3 rho) {
    vec3 change = rho - mu;
    return change * mix(back, min(back, vec3(ALBEDO_RANGE.y / PI)), greaterThan(change, vec3(0.0)));
}
#endif

#if defined(GROUP_SUMS_ACCESS) && !defined(FINDS_GROUPS)
// Light of mu on a surfel, for its group's albedo.
void add_to_group(Surfel s, vec3 n, vec3 mu, vec3 radiance) {
    int slot = group_of(s, n);
    if (slot < 0) return;
    float scale = s.position_area.w / (voxel_edge * voxel_edge) * LIGHT_FIXED_POINT;
    atomicAdd(group_sums[slot * GROUP_SUMS + GROUP_IRRADIANCE], int(round(scale * dot(mu, LUMINANCE))));
    atomicAdd(group_sums[slot * GROUP_SUMS + GROUP_RADIANCE], int(round(scale * dot(radiance, LUMINANCE))));
}
#else
void add_to_group(Surfel s, vec3 n, vec3 mu, vec3 radiance) {}
#endif

#ifdef SOLUTION
vec3 outgoing(Surfel s, vec3 n, uint own) {
    vec3 p = s.position_area.xyz, mu, rho;
    irradiances(s, n, own, mu, rho);
    bool seen = camera_sees(p, n);
    vec3 back = unseen_albedo(p) / PI;
    vec3 radiance = seen ? measured_radiance(p) : back * mu;
    add_to_group(s, n, mu, radiance);
#ifdef REAL_RHO
    if (seen) back = radiance / (mu + 1e-6);
    radiance += change_of(back, mu, rho);
#endif
    return radiance;
}
#endif

#ifdef REAL_DELTA
#include "common/least_change.glsl"

// L_rho - L_mu; 0 where gathered light hardly changes, so that mu and rho are equal there, and need no two marches.
vec3 outgoing(Surfel s, vec3 n, uint own) {
    vec3 mu, rho;
    irradiances(s, n, own, mu, rho);
    add_to_group(s, n, mu, surfel_light(own, RADIANCE_MU).rgb);
#if defined(GATHERED) || defined(FROM_MU)
    if (all(lessThanEqual(abs(rho - mu), LEAST_CHANGE * max(mu, rho)))) return vec3(0.0);
#endif
    return change_of(surfel_light(own, RADIANCE_MU).rgb / (mu + 1e-6), mu, rho);
}
#endif

void light(Surfel s, uint own, vec3 n) {
    uint voxel = floatBitsToUint(s.uv_voxel.z);
    ivec3 v = enter_volume_of(voxel, volume_size);
    occupy(v);
    find_group(voxel, n);
    vec3 radiance = outgoing(s, n, own);
#if defined(REAL_DELTA) || defined(GATHERED)
    if (radiance == vec3(0.0)) return;
#endif
#ifdef REAL_DELTA
    int held = 6 * volume;
    for (int j = 0; j < 3; ++j) { atomicMin(support[held + j], v[j]); atomicMin(support[held + 3 + j], -v[j]); }
#endif
    float area = s.position_area.w, opaque = 1.0;
#if defined(VIRTUAL) && defined(MATERIAL_MAPS)
    area *= opacity_of(int(s.normal_material.w), s.uv_voxel.xy, s.tint.w, sqrt(area));
#endif
#if defined(VIRTUAL) && defined(TRANSMISSION)
    Material m = material_of(int(s.normal_material.w), s.uv_voxel.xy, s.tint.rgb, sqrt(s.position_area.w));
    vec3 passing = m.passing * (1.0 - mean_specular_reflectance(m.f0, m.roughness));
#ifdef EXTENDED
    passing *= mean_below(m.over);
#endif
    opaque -= dot(passing, vec3(1.0 / 3.0));
#endif
    add(voxel, n, area, opaque, radiance);
}

void main() {
    uint count = surfels_held(), i = first_item();
    if (i < count) do {
        Surfel s = surfels[i];
        uint sides = s.uv_voxel.w > 0.5 ? 2u : 1u;   // a loop: software renderers would run a branch for all
        uint side = 0u;
        do light(s, 2u * i + side, side == 0u ? s.normal_material.xyz : -s.normal_material.xyz); while (++side < sides);
    } while ((i += items_apart()) < count);
}
