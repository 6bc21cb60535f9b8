// Injection of what surfaces do to the light of the surroundings. The fields outside hold the surroundings R as if
// nothing stood in the volume; so each surface element sends what it reflects of R (and emits), less what would have come
// through it from behind: E_R(n) albedo - E_R(-n). This is how the volume blocks natural light, and how nothing counts
// twice where R stands for ground that lies in the volume.
#include "passes/common/volume.glsl"
#include "passes/common/voxel_store.glsl"
#include "passes/common/lights.glsl"
#include "passes/common/environment.glsl"
#include "passes/common/materials.glsl"
#include "passes/common/inject_light.glsl"

layout(local_size_x = 64) in;
uniform float bias_real;   // m
uniform bool blocks_surroundings;
const vec2 ALBEDO_RANGE = vec2(0.02, 0.95);

#ifdef REAL
#include "passes/common/real_radiance.glsl"

// As the picture shows it under the light that gets there ([P2] eq. 1), or as remembered.
vec3 albedo_at(Surfel s, vec3 n) {
    vec3 p = s.position_area.xyz;
    if (!camera_sees(p)) return unseen_albedo(p);
    vec3 e = environment_irradiance(n);
    for (int i = 0; i < light_count; ++i) {
        vec3 to_light; float radius;
        vec3 across = light_at(lights[i], p, n, to_light, radius);
        float cosine = dot(n, to_light);
        if (cosine > 0.0) e += across * cosine * real_visibility(lights[i], p, n, bias_real);
    }
    return clamp(PI * measured_radiance(p) / max(e, vec3(1e-6)), ALBEDO_RANGE.x, ALBEDO_RANGE.y);
}

vec3 emission_of(Surfel s) { return vec3(0.0); }
#else
vec3 albedo_at(Surfel s, vec3 n) {
    Material m = material_of(int(s.normal_material.w), s.uv_voxel.xy, s.tint.rgb);
    return min(m.diffuse + m.f0, vec3(ALBEDO_RANGE.y));
}

vec3 emission_of(Surfel s) { return materials[int(s.normal_material.w)].emission.rgb; }
#endif

void inject_side(Surfel s, vec3 n) {
    vec3 radiosity = PI * emission_of(s);
    if (blocks_surroundings) radiosity += albedo_at(s, n) * environment_irradiance(n) - environment_irradiance(-n);
    if (radiosity != vec3(0.0)) inject(s.position_area.xyz, n, radiosity * s.position_area.w);
}

void main() {
    uint count = min(surfel_count, surfel_capacity);
    for (uint i = gl_GlobalInvocationID.x; i < count; i += gl_NumWorkGroups.x * 64u) {
        Surfel s = surfels[i];
        inject_side(s, s.normal_material.xyz);
        if (s.uv_voxel.w > 0.5) inject_side(s, -s.normal_material.xyz);
    }
}
