// Direct irradiance of the real surface at each pixel without and with the virtual objects (docs/method.md 3, direct), and
// the light lobes on declared specular surfaces. SPARED: where the light without the objects is known, and no shadow of
// theirs falls.
#include "common/lit_pixels.glsl"
#include "common/light_reach.glsl"
#include "common/kept_surface.glsl"
#include "common/brdf.glsl"
#include "common/surfaces.glsl"
#include "common/caustics.glsl"
#include "common/work_list.glsl"

layout(local_size_x = 64) in;
uniform float beam_alpha;
layout(rgba16f) uniform image2D direct_mu;              // rgb E_mu; a: unshadowed E, mean of channels
layout(rgba16f) writeonly uniform image2D direct_rho;   // rgb E_rho
layout(rgba16f) writeonly uniform image2D lobe_mu;      // rgb radiance of light lobes
layout(rgba16f) writeonly uniform image2D lobe_rho;
#pragma switch bool specular_surfaces
// Whether direct_mu holds what the last frame found; a = 0: nothing.
#pragma switch bool keeps_unblocked

#if defined(TRANSMISSION) && defined(RAY_SHADOWS)
#include "common/ray_shadows.glsl"

vec2 light_visibility(Light light, vec3 p, vec3 on_real, vec3 n, float bias) {
    vec2 seen = visibility(light, p, on_real, n, bias, bias);
    if (seen.y > 0.0 && seen.y < seen.x && !is_rectangle(light) && !is_image(light)) seen.y = seen.x * unblocked_fraction(light, p);
    return seen;
}
#elif defined(SHADOW_CONES)
vec2 light_visibility(Light light, vec3 p, vec3 on_real, vec3 n, float bias) { return cone_visibility(light, p, on_real, n, bias); }
#elif defined(REAL_SHADOWS)
vec2 light_visibility(Light light, vec3 p, vec3 on_real, vec3 n, float bias) { return real_visibilities(light, on_real, n, bias); }
#else
vec2 light_visibility(Light light, vec3 p, vec3 on_real, vec3 n, float bias) { return visibility(light, p, on_real, n, bias, bias); }
#endif

void light(ivec2 pixel, ivec2 size) {
    vec4 position = texelFetch(real_surface_position, pixel, 0);
    vec4 normal = texelFetch(real_surface_normal, pixel, 0);
    vec3 e_mu = vec3(0.0), e_rho = vec3(0.0), s_mu = vec3(0.0), s_rho = vec3(0.0);
    float unshadowed = 0.0;
    float bias = shadow_bias(position.w);
    bool reached = light_may_change(pixel, position, normal.xyz);
    vec4 kept = keeps_unblocked ? imageLoad(direct_mu, pixel) : vec4(0.0);
    bool known = kept.a > 0.0 && !shadow_may_reach(position.xyz, normal.xyz, bias);
    if (reached) {
#ifndef SPARED
        vec3 v = normalize(camera_position - position.xyz);
        vec3 on_real = on_kept_surface(position.xyz, normal.xyz, bias);
        int i = 0;
        if (!known && light_count > 0) do {
            vec3 l; float radius;
            vec3 e_perp = light_at(listed_light(i), position.xyz, normal.xyz, l, radius);
            float cosine = dot(normal.xyz, l);
            if (cosine <= 0.0) continue;
            vec2 seen = light_visibility(listed_light(i), position.xyz, on_real, normal.xyz, bias);
            e_mu += e_perp * cosine * seen.x;
            vec3 arrives = arriving(listed_light(i), position.xyz, seen, beam_alpha);
            e_rho += e_perp * cosine * arrives;
            unshadowed += is_object_lamp(listed_light(i)) ? 0.0 : dot(e_perp, vec3(1.0 / 3.0)) * cosine;
            if (specular_surfaces && normal.w >= 0.0) {
                SurfaceEntry e = surfaces[int(normal.w)];
                vec3 lobe = e_perp * specular_times_cosine(normal.xyz, v, l, e.f0.rgb, e.surface.x, vec2(radius, 0.0));
                s_mu += lobe * seen.x;
                s_rho += lobe * arrives;
            }
        } while (++i < light_count);
#endif
    }
    if (known) { e_mu = e_rho = kept.rgb; unshadowed = kept.a; }
    enter_volume(position.xyz);
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
    int grid_width = (size.x + scale - 1) / scale;
    int block = scale * scale;
    uint count = listed_count() * uint(block), i = first_item();
    if (i < count) do {
        int number = quotient(int(i), block);
        ivec2 pixel = pixel_in_block(texel_of_index(texels[number], grid_width), int(i) - number * block, scale);
        if (all(lessThan(pixel, size))) light(pixel, size);
    } while ((i += items_apart()) < count);
}
