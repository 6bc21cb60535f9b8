// Injects the surfaces' effect on the environment's light. The fields outside hold the environment R as if the volume
// were empty; so each surface element sends what it reflects of R (and emits), minus what would have come through it
// from behind: E_R(n) albedo - E_R(-n). This is how the volume blocks natural light, and why nothing counts twice
// where R represents ground that is in the volume.
#include "common/volume.glsl"
#include "common/voxel_store.glsl"
#include "common/lights.glsl"
#include "common/environment.glsl"
#include "common/materials.glsl"
#include "common/inject_light.glsl"
#include "common/surfel_albedo.glsl"

layout(local_size_x = 64) in;
uniform bool blocks_environment;

#ifdef REAL
vec3 reflectance(Surfel s, vec3 n) { return albedo_at(s, n, environment_irradiance(n)); }
vec3 emission_of(Surfel s) { return vec3(0.0); }
#else
vec3 reflectance(Surfel s, vec3 n) { return virtual_albedo(s); }
vec3 emission_of(Surfel s) { return materials[int(s.normal_material.w)].emission.rgb; }
#endif

vec3 sent_out(Surfel s, vec3 n) {
    vec3 radiosity = PI * emission_of(s);
    if (blocks_environment) radiosity += reflectance(s, n) * environment_irradiance(n) - environment_irradiance(-n);
    return radiosity;
}

#include "common/inject_surfels.glsl"
