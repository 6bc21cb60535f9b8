// Diffuse and specular cones of the paper's operator at 1/scale of the picture ([P1] eq. 6 and 8). REAL: C_delta, the
// change of light on real surfaces. VIRTUAL: C_rho, the light of the volume on the objects, and of the environment in
// the rest of a cone.
#include "common/paper_cones.glsl"
#include "common/brdf.glsl"
#include "common/low_res_grid.glsl"
#include "common/walk.glsl"

#include "common/pixel_group.glsl"
#ifdef REAL
layout(rgba16f) writeonly uniform image2D irradiance_mu;    // rgb ambient E_mu, a: 1 where known
layout(rgba16f) writeonly uniform image2D irradiance_rho;   // rgb E_mu + E of C_delta, a: volume fade
layout(rgba16f) writeonly uniform image2D specular_mu;      // rgb mirrored radiance that objects hide
layout(rgba16f) writeonly uniform image2D specular_rho;     // rgb C_delta of the specular cone
uniform sampler2D linear_picture;
#pragma texels rgba16f linear_picture
#include "common/object_box.glsl"
#else
layout(rgba16f) writeonly uniform image2D irradiance_rho;   // rgb E_rho, a: 1 where traced
layout(rgba16f) writeonly uniform image2D specular_rho;     // rgb mean radiance of the specular cone
#endif
uniform sampler3D mipmap;   // V_delta for REAL, V_rho otherwise; a: V_eta
#include "common/camera.glsl"

void store_specular(ivec2 texel, vec3 mu, vec3 rho) {
#ifdef REAL
    imageStore(specular_mu, texel, vec4(mu, 1.0));
#endif
    imageStore(specular_rho, texel, vec4(rho, 1.0));
}

#ifdef REAL
// What the real mirror shows at the texel's pixel: the picture on a metal; otherwise its reflection of the
// environment.
vec3 mirrored(ivec2 texel, SurfacePoint s, vec3 v, vec3 d, float half_angle) {
    ivec2 pixel = texelFetch(sample_pixels, texel, 0).xy;
    SurfaceEntry e = surfaces[int(texelFetch(real_surface_normal, pixel, 0).w)];
    if (e.f0.w < 0.5) return environment(d, half_angle);
    vec3 reflectance = specular_reflectance(e.f0.rgb, s.roughness, max(dot(s.normal, v), 1e-3));
    return texelFetch(linear_picture, pixel, 0).rgb / max(reflectance, vec3(1e-3));
}

// The part of a cone from q that the objects of all volumes cover.
float hidden_by_objects(vec3 q, vec3 d, float ratio) {
    int home = volume;
    float hidden = 0.0;
    for (int chosen = 0; chosen < volume_count; ++chosen) {
        work_in_volume(chosen);
        vec3 start = coordinate_from(q, home);
        vec2 within = box_interval(start, d, object_low() - 0.5, object_high() + 0.5);
        hidden += (1.0 - hidden) * march(mipmap, start, d, ratio, within).a;
    }
    work_in_volume(home);
    return hidden;
}

// C_delta adds the radiance of the object's voxels; their opacity removes what was mirrored from there ([P1] 3.2).
void specular(ivec2 texel, SurfacePoint s, vec3 q) {
    vec3 v = normalize(camera_position - s.position);
    vec3 d = reflect(-v, s.normal);
    float half_angle = specular_half_angle(s.roughness);
    float ratio = 2.0 * tan(half_angle);
    vec3 added = march_on(mipmap, q, d, ratio).rgb;
    store_specular(texel, hidden_by_objects(q, d, ratio) * mirrored(texel, s, v, d, half_angle), added);
}

void shade(ivec2 texel, SurfacePoint s) {
    vec3 q = volume_coordinate(s.position);
    float fade = s.present ? volume_fade(q) : 0.0;
    vec3 e = s.present ? environment_irradiance(s.normal) : vec3(0.0);
    imageStore(irradiance_mu, texel, vec4(e, s.present ? 1.0 : 0.0));
    if (fade > 0.0) e += diffuse(mipmap, q + START * s.normal, s.normal, false);
    imageStore(irradiance_rho, texel, vec4(e, fade));
    if (fade > 0.0 && s.roughness >= 0.0) specular(texel, s, q + START * s.normal);
    else store_specular(texel, vec3(0.0), vec3(0.0));
}
#else
void shade(ivec2 texel, SurfacePoint s) {
    vec3 e = vec3(0.0), c = vec3(0.0);
    if (s.present) {
        vec3 q = volume_coordinate(s.position) + START * s.normal;
        e = diffuse(mipmap, q, s.normal, true);
        vec3 d = reflect(normalize(s.position - camera_position), s.normal);
        float half_angle = specular_half_angle(s.roughness);
        vec4 met = march_on(mipmap, q, d, 2.0 * tan(half_angle));
        c = met.rgb + (1.0 - met.a) * environment(d, half_angle);
    }
    imageStore(irradiance_rho, texel, vec4(e, s.present ? 1.0 : 0.0));
    store_specular(texel, vec3(0.0), c);
}
#endif

void main() {
    ivec2 texel = ivec2(spread_place() * gl_WorkGroupSize.xy + gl_LocalInvocationID.xy);
    if (any(greaterThanEqual(texel, low_resolution_size))) return;
    SurfacePoint s = surface_point(texel);
    enter_volume(s.position);
    shade(texel, s);
}
