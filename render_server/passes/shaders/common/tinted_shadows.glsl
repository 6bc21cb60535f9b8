// Shadows of transparent objects, tinted by what these transmit.
#include "common/soft_shadows.glsl"

#ifdef TRANSMISSION   // a switch of the shaders that ask for it
#ifndef OPAQUE_SHADOWS
#define TINTED_SHADOWS
#endif
#endif
#ifdef TINTED_SHADOWS
layout(std430) readonly buffer Transmittances { vec4 transmittances[]; };   // of materials: rgb; alpha
uniform sampler2D object_rsm_normal;   // w: material
#pragma texels rgba16f object_rsm_normal

// Sum of what the objects' first surfaces around a receiver let through, and how many block it. What beams carry counts as blocked.
vec4 transmittance_sum(Light light, LightView view, vec3 p, float beam_alpha) {
    vec3 v = (view.view_from_world * vec4(p, 1.0)).xyz;
    vec2 s = lateral(view, v);
    LightExtent k = light_extent(light, view, s, v.z);
    vec4 sum = vec4(0.0);
    for (int j = 0; j < shadow_samples; ++j) {
        vec2 offset = lateral_shift(k, drift(view, v.z, view.range.x), light_sample(k, j, shadow_samples));
        vec2 t = tile_texel(view, s + offset);
        if (t.x < 0.0 || first_depth(object_rsm_depth, view, ivec2(t)) >= v.z) continue;
        vec4 through = transmittances[int(texelFetch(object_rsm_normal, ivec2(t), 0).w)];
        sum += vec4(through.a < beam_alpha ? vec3(0.0) : through.rgb, 1.0);
    }
    return sum;
}
#endif

// Fraction of a light's channels that arrives at p, of its visibility `seen` without and with the objects: transparent ones let some
// of what they block through. `beam_alpha`: of the roughest objects through which beams bring it.
vec3 arriving(Light light, vec3 p, vec2 seen, float beam_alpha) {
#ifdef TINTED_SHADOWS
    vec4 sum = vec4(0.0);
    if (light.views.w > 0 && seen.x > seen.y)
        sum = transmittance_sum(light, listed_view(view_containing(light.views.z, light.views.w, p)), p, beam_alpha);
    return vec3(seen.y) + max(seen.x - seen.y, 0.0) * sum.rgb / max(sum.a, 1.0);
#else
    return vec3(seen.y);
#endif
}
