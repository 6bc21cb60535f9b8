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

layout(local_size_x = 8, local_size_y = 8) in;
layout(rgba16f) writeonly uniform image2D irradiance_mu;
layout(rgba16f) writeonly uniform image2D irradiance_rho;
layout(rgba16f) writeonly uniform image2D specular_mu;
layout(rgba16f) writeonly uniform image2D specular_rho;
#include "common/camera.glsl"
uniform bool everywhere;   // also out of the objects' reach (photometric registration)

#ifdef REUSES
uniform usampler2D stale_texels;
uniform isampler2D last_sample_pixels;
uniform sampler2D last_cone_mu;
uniform sampler2D last_cone_rho;
uniform int scale;

// Takes the light of the last frame's texels on this one's surface, if there are any and it is not this texel's turn.
bool remembered(ivec2 texel, SurfacePoint s) {
    if (!has_history || s.roughness >= 0.0 || (texelFetch(stale_texels, texel, 0).r & STALE_REAL) != 0u) return false;
    vec4 mu = vec4(0.0), rho = vec4(0.0), position = vec4(s.position, (camera_from_world * vec4(s.position, 1.0)).z);
    vec2 at = last_pixel(s.position) / float(scale) - 0.5;
    float total = 0.0;
    for (int j = 0; j < 4; ++j) {
        ivec2 other = clamp(ivec2(floor(at)) + ivec2(j & 1, j >> 1), ivec2(0), low_resolution_size - 1);
        ivec2 pixel = texelFetch(last_sample_pixels, other, 0).xy;
        if (pixel.x < -1) pixel = -2 - pixel;
        vec4 light = texelFetch(last_cone_mu, other, 0);
        vec3 off = texelFetch(last_position, max(pixel, ivec2(0)), 0).xyz - s.position;
        if (pixel.x < 0 || light.a <= 0.0 || abs(dot(off, s.normal)) > OFF_PLANE * pixel_size * position.w) continue;
        float w = bilinear(at, j) + 1e-3;
        total += w;
        mu += w * light;
        rho += w * texelFetch(last_cone_rho, other, 0);
    }
    if (total < LEAST_WEIGHT) return false;
    imageStore(irradiance_mu, texel, mu / total);
    imageStore(irradiance_rho, texel, rho / total);
    imageStore(specular_mu, texel, vec4(0.0, 0.0, 0.0, 1.0));
    imageStore(specular_rho, texel, vec4(0.0, 0.0, 0.0, 1.0));
    return true;
}
#else
bool remembered(ivec2 texel, SurfacePoint s) { return false; }
#endif

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
    if (!reached) leave(texel, s);
    else if (!remembered(texel, s)) append_texel(texel, low_resolution_size.x);
}
