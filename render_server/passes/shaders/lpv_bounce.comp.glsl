// Injects the reflection of propagated light: of virtual surfaces all of it, of real ones only the objects' change of
// it (the picture shows the rest, which is in V_mu).
#include "common/volume.glsl"
#include "common/voxel_store.glsl"
#include "common/lights.glsl"
#include "common/environment.glsl"
#include "common/materials.glsl"
#include "common/inject_light.glsl"
#include "common/lpv_light.glsl"
#include "common/surfel_albedo.glsl"

layout(local_size_x = 64) in;

vec3 brought(bool with_objects, Surfel s, vec3 n) {
    return from_volume(with_objects, volume_coordinate(s.position_area.xyz), n);
}

#ifdef REAL
vec3 sent_out(Surfel s, vec3 n) {
    vec3 natural = environment_irradiance(n);
    vec3 e_mu = max(natural + brought(false, s, n), vec3(0.0));
    vec3 e_rho = max(natural + brought(true, s, n), vec3(0.0));
    return albedo_at(s, n, e_mu) * (e_rho - e_mu);
}
#else
vec3 sent_out(Surfel s, vec3 n) { return virtual_albedo(s) * brought(true, s, n); }
#endif

#include "common/inject_surfels.glsl"
