// Sum each surfel's opacity and outgoing radiance into its voxel, per direction k (METHOD 4.3):
//   a_k += A max(0, -n.k) / h^2,   c_k += L A max(0, -n.k) / h^2.
// REAL: L_mu is what the camera measured (all bounces), or albedo / pi E_mu where it does not look;
//       REAL_DELTA sums L_rho - L_mu = L_mu (ratio - 1), ratio = E_rho / E_mu of direct + ambient light.
// VIRTUAL: L_rho = albedo / pi E_rho + emission.
#include "passes/common/volume.glsl"
#include "passes/common/voxel_store.glsl"
#include "passes/common/lights.glsl"
#include "passes/common/environment.glsl"
#include "passes/common/materials.glsl"

layout(local_size_x = 64) in;
uniform float bias_real;      // m
uniform float bias_virtual;   // m
#if defined(REAL) || defined(REAL_DELTA)
#include "passes/common/real_radiance.glsl"
#endif
#ifdef REAL_DELTA
layout(std430, binding = 8) buffer DeltaSums { int delta_sums[]; };   // 18 a slot
layout(std430, binding = 9) buffer Support { int support[6]; };        // bounds of changed voxels: min xyz, -max xyz
#endif

// (E_mu, E_rho) of direct and ambient light.
void irradiances(vec3 p, vec3 n, out vec3 mu, out vec3 rho) {
    mu = environment_irradiance(n);
    rho = mu;
    for (int i = 0; i < light_count; ++i) {
        vec3 to_light; float radius;
        vec3 across = light_at(lights[i], p, to_light, radius);
        float cosine = dot(n, to_light);
        if (cosine <= 0.0) continue;
        vec2 v = visibility(lights[i], p, n, bias_real, bias_virtual);
        mu += across * cosine * v.x;
        rho += across * cosine * v.y;
    }
}

void add(uint voxel, vec3 n, float area, vec3 radiance) {
    int slot = int(grid[voxel]) - 1;
    float scale = area / (voxel_edge * voxel_edge);
    for (int k = 0; k < 6; ++k) {
        float share = max(0.0, -dot(n, axis_direction(k))) * scale;
        if (share <= 0.0) continue;
#ifdef REAL_DELTA
        int at = slot * 18 + k * 3;
        for (int j = 0; j < 3; ++j) atomicAdd(delta_sums[at + j], fixed_point(radiance[j] * share));
#else
        int at = slot * SUMS_PER_SLOT;
        atomicAdd(sums[at + COVERAGE + k], fixed_point(share));
        for (int j = 0; j < 3; ++j) atomicAdd(sums[at + RADIANCE + k * 3 + j], fixed_point(radiance[j] * share));
#endif
    }
}

void light(Surfel s, vec3 n) {
    vec3 p = s.position_area.xyz;
    uint voxel = floatBitsToUint(s.uv_voxel.z);
    vec3 mu, rho;
#if defined(VIRTUAL)
    irradiances(p + n * voxel_edge * 0.1, n, mu, rho);
    Material m = material_of(int(s.normal_material.w), s.uv_voxel.xy, s.tint.rgb);
    vec3 radiance = (m.diffuse + m.f0) / PI * rho + m.emission;
#elif defined(REAL_DELTA)
    irradiances(p, n, mu, rho);
    if (mu == rho) return;
    vec3 radiance = real_radiance(p, mu) * ((rho + 1e-6) / (mu + 1e-6) - 1.0);
    ivec3 v = voxel_of_index(voxel, volume_size);
    for (int j = 0; j < 3; ++j) { atomicMin(support[j], v[j]); atomicMin(support[3 + j], -v[j]); }
#else
    vec3 radiance = vec3(0.0);
    if (camera_sees(p)) radiance = measured_radiance(p);
    else { irradiances(p, n, mu, rho); radiance = predicted_radiance(mu); }
#endif
    add(voxel, n, s.position_area.w, radiance);
}

void main() {
    uint count = min(surfel_count, surfel_capacity);
    for (uint i = gl_GlobalInvocationID.x; i < count; i += gl_NumWorkGroups.x * 64u) {
        Surfel s = surfels[i];
        light(s, s.normal_material.xyz);
        if (s.uv_voxel.w > 0.5) light(s, -s.normal_material.xyz);
    }
}
