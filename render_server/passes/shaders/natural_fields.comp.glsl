// Natural light that the objects leave, and light that they add -> the fields that other methods trace by cones.
// REAL: E_mu and E_rho of real surfaces, whose reflections stay. Otherwise the light on the objects and in their
// mirrors.
#include "common/environment.glsl"
#include "common/brdf.glsl"
#include "common/low_res_grid.glsl"

#include "common/pixel_group.glsl"
#ifdef REAL
layout(rgba16f) writeonly uniform image2D irradiance_mu;    // rgb E_mu, a: 1 where known
layout(rgba16f) writeonly uniform image2D irradiance_rho;   // rgb E_rho, a: 1, the field itself ends softly
layout(rgba16f) writeonly uniform image2D specular_mu;
#else
layout(rgba16f) writeonly uniform image2D irradiance_rho;
#endif
layout(rgba16f) writeonly uniform image2D specular_rho;
uniform sampler2D unoccluded;
uniform sampler2D natural;
uniform sampler2D bounce_irradiance;
uniform sampler2D mirrored;
uniform sampler2D bounce_mirrored;
#include "common/camera.glsl"
uniform bool has_bounce_light;

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, low_resolution_size))) return;
    SurfacePoint s = surface_point(texel);
    float known = s.present ? 1.0 : 0.0;
    vec3 e_mu = vec3(0.0), e_rho = vec3(0.0);
    float weight = 1.0;
    if (s.present) {
        vec4 e = texelFetch(natural, texel, 0);
        weight = e.a;
        e_mu = max(e.rgb / weight, vec3(0.0));
        e_rho = e_mu * texelFetch(unoccluded, texel, 0).rgb;
        if (has_bounce_light) e_rho += texelFetch(bounce_irradiance, texel, 0).rgb;
    }
    vec3 c = vec3(0.0);
#ifdef REAL
    if (s.roughness >= 0.0)
        c = environment(reflect(normalize(s.position - camera_position), s.normal), specular_half_angle(s.roughness));
    imageStore(irradiance_mu, texel, vec4(e_mu, known));
    imageStore(irradiance_rho, texel, vec4(e_rho, known));
    imageStore(specular_mu, texel, vec4(c, 1.0));
#else
    if (s.present) {
        vec4 m = texelFetch(mirrored, texel, 0);
        c = m.a / weight * m.rgb;
        if (has_bounce_light) c += texelFetch(bounce_mirrored, texel, 0).rgb;
    }
    imageStore(irradiance_rho, texel, vec4(e_rho, known));
#endif
    imageStore(specular_rho, texel, vec4(c, 1.0));
}
