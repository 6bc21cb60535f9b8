// Injection of what surfaces reflect of the light that propagation brought to them: of virtual ones all of it, of real
// ones what the objects change of it (the picture shows the rest, and that is in V_mu).
#define SURFELS_ACCESS readonly
#include "common/volume.glsl"
#include "common/voxel_store.glsl"
#include "common/environment.glsl"
#include "common/inject_light.glsl"
#include "common/lpv_light.glsl"
#include "common/surfel_albedo.glsl"

layout(local_size_x = 64) in;

Brought brought_to(Surfel s, vec3 n) { return brought(volume_coordinate(s.position_area.xyz), n); }

#ifdef REAL
vec3 sent_out(Surfel s, vec3 n) {
    vec3 natural = environment_irradiance(n);
    Brought e = brought_to(s, n);
    vec3 e_mu = max(natural + e.mu, vec3(0.0)), e_rho = max(natural + e.rho, vec3(0.0));
    return albedo_at(s, n, e_mu) * (e_rho - e_mu);
}
#ifdef BOTH
vec3 sent_out_by_object(Surfel s, vec3 n) { return virtual_albedo(s) * brought_to(s, n).rho; }
#endif
#else
vec3 sent_out(Surfel s, vec3 n) { return virtual_albedo(s) * brought_to(s, n).rho; }
#endif

#include "common/inject_surfels.glsl"
