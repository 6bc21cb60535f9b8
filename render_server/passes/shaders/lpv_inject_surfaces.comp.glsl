// Injection of what surfaces do to the light of the environment. The fields outside hold the environment R as if
// nothing stood in the volume; so each surface element sends what it reflects of R (and emits), less what would have come
// through it from behind: E_R(n) albedo - E_R(-n). This is how the volume blocks natural light, and how nothing counts
// twice where R stands for ground that lies in the volume.
#define SURFELS_ACCESS readonly
#include "common/volume.glsl"
#include "common/voxel_store.glsl"
#include "common/environment.glsl"
#include "common/inject_light.glsl"
#include "common/surfel_albedo.glsl"

layout(local_size_x = 64) in;
uniform bool blocks_environment;

#ifdef REAL
vec3 reflectance(Surfel s, vec3 n) { return albedo_at(s, n, environment_irradiance(n)); }
vec3 emission_of(Surfel s) { return vec3(0.0); }
#else
vec3 reflectance(Surfel s, vec3 n) { return virtual_albedo(s); }
vec3 emission_of(Surfel s) { return virtual_emission(s); }
#endif

vec3 sent_out(Surfel s, vec3 n) {
    vec3 radiosity = PI * emission_of(s);
    if (blocks_environment) radiosity += reflectance(s, n) * environment_irradiance(n) - environment_irradiance(-n);
    return radiosity;
}

#include "common/inject_surfels.glsl"
