// Irradiance from the light volumes at 1/scale of the picture (docs/method.md 5), in addition to the environment R.
// REAL: E_mu and E_rho of real surfaces; CHANGE: E_rho = E_mu + the volumes of the change, indirect and direct. VIRTUAL: the
// light on the objects, and what a mirror on them would see. BOTH of these: of the objects by workgroups with z = 1.
#include "common/environment.glsl"
#include "common/brdf.glsl"
#include "common/volume.glsl"
#include "common/lpv_light.glsl"
#include "common/lpv_exchange.glsl"
#include "common/low_res_grid.glsl"

#include "common/pixel_group.glsl"
#if defined(REAL) || defined(BOTH)
#define READS_REAL
layout(rgba16f) writeonly uniform image2D irradiance_mu;    // rgb E_mu, a: 1 where known
layout(rgba16f) writeonly uniform image2D irradiance_rho;   // rgb E_rho, a: volume fade
layout(rgba16f) writeonly uniform image2D specular_mu;
layout(rgba16f) writeonly uniform image2D specular_rho;
#ifdef CHANGE
uniform int direct_size;   // cells an edge of the direct change, in place of the light without objects; 0: none
#endif
#endif
#ifndef REAL
#define READS_OBJECTS
layout(rgba16f) writeonly uniform image2D object_irradiance;   // rgb E_rho, a: 1 where known
layout(rgba16f) writeonly uniform image2D object_specular;
#endif
#include "common/camera.glsl"

const float RIM = 2.0;   // cells over which the change fades at the border

float border_fade(vec3 q) {
    vec3 rim = min(q, float(volume_size) - q);
    return smoothstep(0.0, RIM, min(rim.x, min(rim.y, rim.z)));
}

// What a mirror at the point would show of the environment if the volume were empty.
vec3 mirrored(SurfacePoint s) {
    if (s.roughness < 0.0) return vec3(0.0);
    return environment(reflect(normalize(s.position - camera_position), s.normal), specular_half_angle(s.roughness));
}

#ifdef READS_REAL
void shade_real(ivec2 texel, SurfacePoint s) {
    enter_volume(s.position);
    vec3 q = volume_coordinate(s.position);
    vec3 e_mu = vec3(0.0), e_rho = vec3(0.0), c = vec3(0.0);
    float fade = s.present ? border_fade(q) : 0.0;
    if (s.present) {
        c = mirrored(s);
        e_mu = environment_irradiance(s.normal);
        e_rho = e_mu;
    }
    if (fade > 0.0) {
#ifdef CHANGE
        e_rho += brought(q, s.normal).rho + from_other_volumes(s.position, s.normal);
        if (direct_size > 0) e_rho += brought_in(direct_size, q * float(direct_size) / float(volume_size), s.normal).mu;
#else
        Brought e = brought(q, s.normal);
        vec3 change = e.rho - e.mu + from_other_volumes(s.position, s.normal);
        e_rho = max(e_mu + fade * e.mu + change, vec3(0.0));   // composition fades the change
        e_mu = max(e_mu + fade * e.mu, vec3(0.0));
#endif
    }
    imageStore(irradiance_mu, texel, vec4(e_mu, s.present ? 1.0 : 0.0));
    imageStore(irradiance_rho, texel, vec4(e_rho, fade));
    imageStore(specular_mu, texel, vec4(c, 1.0));
    imageStore(specular_rho, texel, vec4(c, 1.0));
}
#endif

#ifdef READS_OBJECTS
void shade_object(ivec2 texel, SurfacePoint s) {
    vec3 e = vec3(0.0), c = vec3(0.0);
    if (s.present) {
        enter_volume(s.position);
        vec3 q = volume_coordinate(s.position);
        vec3 arriving = brought(q, s.normal).rho + from_other_volumes(s.position, s.normal);
        e = max(environment_irradiance(s.normal) + arriving, vec3(0.0));
        c = mirrored(s);
    }
    imageStore(object_irradiance, texel, vec4(e, s.present ? 1.0 : 0.0));
    imageStore(object_specular, texel, vec4(c, 1.0));
}
#endif

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, low_resolution_size))) return;
#ifdef BOTH
    if (gl_WorkGroupID.z == 0u) shade_real(texel, real_point(texel));
    else shade_object(texel, object_point(texel));
#elif defined(REAL)
    shade_real(texel, real_point(texel));
#else
    shade_object(texel, object_point(texel));
#endif
}
