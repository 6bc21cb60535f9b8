// The error of tracing volumes that were filtered apart ([P1] eq. 9), E = C_rho - (C_mu + C_delta): irradiance of the nine
// diffuse cones at real surfaces, at 1/scale of the picture.
#include "common/paper_cones.glsl"
#include "common/low_res_grid.glsl"

#include "common/pixel_group.glsl"
layout(rgba16f) writeonly uniform image2D error_out;   // rgb E, a: 1 where known
uniform sampler3D volume_mu;      // of the real scene alone, with its own opacity
uniform sampler3D volume_rho;     // a: V_eta, of the real scene and the objects
uniform sampler3D volume_delta;   // a: V_eta
#include "common/camera.glsl"

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, low_resolution_size))) return;
    SurfacePoint s = surface_point(texel);
    enter_volume(s.position);
    vec3 q = volume_coordinate(s.position);
    bool known = s.present && volume_fade(q) > 0.0;
    vec3 e = vec3(0.0);
    if (known) {
        q += START * s.normal;
        e = diffuse(volume_rho, q, s.normal, false) - diffuse(volume_mu, q, s.normal, false)
            - diffuse(volume_delta, q, s.normal, false);
    }
    imageStore(error_out, texel, vec4(e, known ? 1.0 : 0.0));
}
