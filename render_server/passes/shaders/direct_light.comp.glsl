// Direct irradiance of the real surface at each pixel without and with the virtual objects (docs/method.md 3, direct), and
// the light lobes on declared specular surfaces.
#include "common/lights.glsl"
#include "common/brdf.glsl"
#include "common/geometry.glsl"
#include "common/surfaces.glsl"
#include "common/volume.glsl"
#include "common/caustics.glsl"
#ifdef SHADOW_CONES
#include "common/shadow_cone.glsl"
#endif

#ifdef LISTED
#include "common/work_list.glsl"
layout(local_size_x = 64) in;
#else
layout(local_size_x = 8, local_size_y = 8) in;
#endif
layout(rgba16f) writeonly uniform image2D direct_mu;    // rgb E_mu; a: unshadowed E, mean of channels
layout(rgba16f) writeonly uniform image2D direct_rho;   // rgb E_rho
layout(rgba16f) writeonly uniform image2D lobe_mu;      // rgb radiance of light lobes
layout(rgba16f) writeonly uniform image2D lobe_rho;
#include "common/camera.glsl"
uniform float noise_sigma;   // m at 1 m
#pragma switch bool specular_surfaces
#include "common/lit_area.glsl"

#ifdef SHADOW_CONES
bool shadow_may_reach(vec3 p, vec3 n, float bias) { return object_meets_cone(p, n); }
vec2 light_visibility(Light light, vec3 p, vec3 n, float bias) { return cone_visibility(light, p, n, bias); }
#elif defined(REAL_SHADOWS)
bool shadow_may_reach(vec3 p, vec3 n, float bias) { return false; }
vec2 light_visibility(Light light, vec3 p, vec3 n, float bias) { return vec2(real_visibility(light, p, n, bias)); }
#else
bool shadow_may_reach(vec3 p, vec3 n, float bias) { return object_may_shadow(p, bias); }
vec2 light_visibility(Light light, vec3 p, vec3 n, float bias) { return visibility(light, p, n, bias, bias); }
#endif

void light(ivec2 pixel, ivec2 size) {
    vec4 position = texelFetch(real_surface_position, pixel, 0);
    vec4 normal = texelFetch(real_surface_normal, pixel, 0);
    vec3 e_mu = vec3(0.0), e_rho = vec3(0.0), s_mu = vec3(0.0), s_rho = vec3(0.0);
    float unshadowed = 0.0;
    float bias = 3.0 * noise_sigma * position.w * position.w;
    // Where neither cones nor shadows of the objects reach, the picture stays unchanged.
    bool reached = position.w > 0.0
        && (is_in_lit_area(pixel) || inside_volume(volume_coordinate(position.xyz))
            || shadow_may_reach(position.xyz, normal.xyz, bias));
    if (reached) {
        vec3 v = normalize(camera_position - position.xyz);
        for (int i = 0; i < light_count; ++i) {
            vec3 l; float radius;
            vec3 across = light_at(lights[i], position.xyz, normal.xyz, l, radius);
            float cosine = dot(normal.xyz, l);
            if (cosine <= 0.0) continue;
            vec2 seen = light_visibility(lights[i], position.xyz, normal.xyz, bias);
            e_mu += across * cosine * seen.x;
            e_rho += across * cosine * seen.y;
            unshadowed += dot(across, vec3(1.0 / 3.0)) * cosine;
            if (specular_surfaces && normal.w >= 0.0) {
                SurfaceEntry e = surfaces[int(normal.w)];
                vec3 lobe = across * specular_times_cosine(normal.xyz, v, l, e.f0.rgb, e.surface.x, radius);
                s_mu += lobe * seen.x;
                s_rho += lobe * seen.y;
            }
        }
    }
    float fade = volume_fade(volume_coordinate(position.xyz));
    if (reached && fade > 0.0)
        e_rho += fade * caustic_irradiance(pixel, size, REAL_LAYER, position.xyz, normal.xyz, position.w);
    imageStore(direct_mu, pixel, vec4(e_mu, unshadowed));
    imageStore(direct_rho, pixel, vec4(e_rho, 0.0));
    if (specular_surfaces) {
        imageStore(lobe_mu, pixel, vec4(s_mu, 0.0));
        imageStore(lobe_rho, pixel, vec4(s_rho, 0.0));
    }
}

void main() {
    ivec2 size = textureSize(real_surface_position, 0);
#ifdef LISTED
    int grid_width = (size.x + scale - 1) / scale;
    uint block = uint(scale * scale);
    for (uint i = gl_GlobalInvocationID.x; i < listed_count() * block; i += gl_NumWorkGroups.x * 64u) {
        ivec2 pixel = pixel_in_block(texel_of_index(texels[i / block], grid_width), int(i % block), scale);
        if (all(lessThan(pixel, size))) light(pixel, size);
    }
#else
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (all(lessThan(pixel, size))) light(pixel, size);
#endif
}
