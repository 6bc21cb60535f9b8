// Lists the texels of the reduced grid where cones are to be traced on real surfaces, and fills in the others: there
// the objects have no influence, and the environment is unchanged.
#include "common/environment.glsl"
#include "common/brdf.glsl"
#include "common/volume.glsl"
#include "common/lights.glsl"
#include "common/low_res_grid.glsl"
#define APPENDS_TEXELS
#include "common/work_list.glsl"
#ifdef REUSES
#include "common/reprojection.glsl"
#endif

#include "common/pixel_group.glsl"
layout(rgba16f) writeonly uniform image2D irradiance_mu;
layout(rgba16f) writeonly uniform image2D irradiance_rho;
layout(rgba16f) writeonly uniform image2D specular_mu;
layout(rgba16f) writeonly uniform image2D specular_rho;
#include "common/camera.glsl"
#include "common/lit_area.glsl"

#ifdef REUSES
#include "common/last_texels.glsl"
uniform usampler2D stale_texels;
uniform sampler2D last_cone_mu;
uniform sampler2D last_cone_rho;

// Takes the light of the last frame's texels, if they know it all.
bool remembered(ivec2 texel, SurfacePoint s) {
    if (s.roughness >= 0.0 || (texelFetch(stale_texels, texel, 0).r & STALE_REAL) != 0u) return false;
    vec4 position = vec4(s.position, (camera_from_world * vec4(s.position, 1.0)).z), mu = vec4(0.0), rho = vec4(0.0);
    LastTexels last = last_texels(position, s.normal, false);
    for (int j = 0; j < 4; ++j) {
        if (last.weights[j] == 0.0) continue;
        ivec2 from = last.base + ivec2(j & 1, j >> 1);
        vec4 light = texelFetch(last_cone_mu, from, 0);
        if (light.a < 0.5) return false;   // nothing was traced there
        mu += last.weights[j] * light;
        rho += last.weights[j] * texelFetch(last_cone_rho, from, 0);
    }
    imageStore(irradiance_mu, texel, vec4(mu.rgb, 1.0));
    imageStore(irradiance_rho, texel, rho);
    imageStore(specular_mu, texel, vec4(0.0, 0.0, 0.0, 1.0));
    imageStore(specular_rho, texel, vec4(0.0, 0.0, 0.0, 1.0));
    return true;
}
#else
bool remembered(ivec2 texel, SurfacePoint s) { return false; }
#endif

// Of texels that nothing can reach: the environment alone.
void store_environment(ivec2 texel, SurfacePoint s) {
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
    enter_volume(s.position);
    bool reached = s.present && (is_in_lit_area(real_pixel(texel)) || volume_fade(volume_coordinate(s.position)) > 0.0
        || object_may_shadow(s.position, 0.0, true));
    if (!reached) store_environment(texel, s);
    else if (!remembered(texel, s)) append_texel(texel, low_resolution_size.x);
}
