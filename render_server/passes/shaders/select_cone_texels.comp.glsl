// Lists the texels of the reduced grid where cones are to be traced on real surfaces, and fills in the others: there
// the objects have no influence, and the environment is unchanged.
#include "common/environment.glsl"
#include "common/brdf.glsl"
#include "common/volume.glsl"
#include "common/lights.glsl"
#include "common/low_res_grid.glsl"
#define APPENDS_TEXELS
#include "common/work_list.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
layout(rgba16f) writeonly uniform image2D irradiance_mu;
layout(rgba16f) writeonly uniform image2D irradiance_rho;
layout(rgba16f) writeonly uniform image2D specular_mu;
layout(rgba16f) writeonly uniform image2D specular_rho;
#include "common/camera.glsl"
uniform bool everywhere;   // also out of the objects' reach (photometric registration)

void leave(ivec2 texel, SurfacePoint s) {
    vec3 e = s.present ? environment_irradiance(s.normal) : vec3(0.0);
    vec3 c = vec3(0.0);
    if (s.present && s.roughness >= 0.0)
        c = environment(reflect(normalize(s.position - camera_position), s.normal), specular_half_angle(s.roughness));
    imageStore(irradiance_mu, texel, vec4(e, 0.0));
    imageStore(irradiance_rho, texel, vec4(e, 0.0));
    imageStore(specular_mu, texel, vec4(c, 0.0));
    imageStore(specular_rho, texel, vec4(c, 0.0));
}

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, low_resolution_size))) return;
    SurfacePoint s = surface_point(texel);
    bool reached = s.present && (everywhere || volume_fade(volume_coordinate(s.position)) > 0.0
        || object_may_shadow(s.position, 0.0));
    if (reached) append_texel(texel, low_resolution_size.x); else leave(texel, s);
}
