// Injects reflective shadow maps ([P2] 4.3): the flux that each texel's surface reflects goes into its cells. REAL
// walks a light's map of the real scene: all that it lights. VIRTUAL walks its map of the objects: what they reflect,
// and, negative, what the same rays lit before on the real scene. DIRECT: the light itself, as lobes along its path:
// what now meets the objects, and, negative, what met the real scene before ([P2] 4.3.2).
#include "common/light_rays.glsl"
#ifndef REAL
#include "common/materials.glsl"
#ifdef EXTENDED
#include "common/coating.glsl"
#endif
#endif
#include "common/packing.glsl"
#include "common/volume.glsl"
#include "common/inject_light.glsl"
#include "common/inject_patch.glsl"
#include "common/map_texels.glsl"

layout(local_size_x = 64) in;
uniform sampler2D real_albedo;
uniform sampler2D real_rsm_normal;
uniform sampler2D object_rsm_uv;
uniform sampler2D object_rsm_normal;
#pragma texels rgba16f real_albedo real_rsm_normal object_rsm_normal
#pragma texels rgba32f object_rsm_uv
uniform int view_index;
uniform float bias_real;   // m: how far behind the real map an object's surface may be and still be lit
uniform bool has_caustics; // beams carry the lights' reflections in smooth virtual surfaces

// What a light sees faces it.
vec3 lit_side(vec3 n, vec3 to_light) { return dot(n, to_light) < 0.0 ? -n : n; }

#ifdef REAL
void inject_texel(Light light, LightView view, ivec2 texel, vec2 s, float depth, vec3 p) {
    vec3 n = normalize(texelFetch(real_rsm_normal, texel, 0).xyz);
    vec3 reflected = texel_light(light, view, s) * within_range(light, p) * texelFetch(real_albedo, texel, 0).rgb;
    inject_patch(lit_patch(view, s, p, n), lit_side(n, direction_to_light(light, p)), reflected);
}
#else
vec3 virtual_albedo(ivec2 texel) {
    vec4 uv = texelFetch(object_rsm_uv, texel, 0);
    Material m = material_of(int(texelFetch(object_rsm_normal, texel, 0).w), uv.xy, unpack_color(uv.z), 0.0);
    bool in_beams = has_caustics && m.roughness * m.roughness < GREATEST_ALPHA;   // beams carry these
    vec3 lobe = in_beams ? vec3(0.0) : mean_specular_reflectance(m.f0, m.roughness);
    vec3 albedo = mean_diffuse_reflectance(m.diffuse, m.f0, m.roughness) + lobe;
#ifdef EXTENDED
    albedo = mean_coated_reflectance(m, albedo);
#endif
    return albedo;
}

// A lobe that points where the light travels, in the cell half a cell in front of the surface, towards the light.
void inject_along(Patch lit, vec3 to_light, vec3 flux) {
    lit.p += voxel_edge * to_light;
    inject_patch(lit, -to_light, flux);
}

void inject_texel(Light light, LightView view, ivec2 texel, vec2 s, float depth, vec3 p) {
    vec3 arriving = texel_light(light, view, s) * within_range(light, p);
    Hit real = first_hit(real_rsm_depth, light.views.x, light.views.y, p);
    if (real.present && real.depth < real.ray_depth - bias_real) return;   // the real scene is in front of the object
    vec3 to_light = direction_to_light(light, p), n = normalize(texelFetch(object_rsm_normal, texel, 0).xyz);
    Patch lit = lit_patch(view, s, p, n);
#ifdef DIRECT
    inject_along(lit, to_light, arriving);
#else
    inject_patch(lit, lit_side(n, to_light), arriving * virtual_albedo(texel));
#endif
    if (!real.present) return;
    vec3 real_normal = normalize(texelFetch(real_rsm_normal, real.texel, 0).xyz);
    Patch shadowed = lit_patch(view, s, hit_point(real, real_normal), real_normal);
#ifdef DIRECT
    inject_along(shadowed, to_light, -arriving);
#else
    inject_patch(shadowed, lit_side(real_normal, to_light), -arriving * texelFetch(real_albedo, real.texel, 0).rgb);
#endif
}
#endif

float depth_at(LightView view, ivec2 texel) {
#ifdef REAL
    return first_depth(real_rsm_depth, view, texel);
#else
    return first_depth(object_rsm_depth, view, texel);
#endif
}

bool is_wanted(LightView view, ivec2 texel) { return depth_at(view, texel) != NOTHING; }

void main() {
    LightView view = listed_view(view_index);
    Light light = listed_light(light_of_view(view_index));
    uint i = next_wanted(view, first_item());
    if (i < texels_of(view)) do {
        ivec2 texel = map_texel(view, i);
        vec2 s = texel_lateral(view, texel);
        float depth = depth_at(view, texel);
        inject_texel(light, view, texel, s, depth, ray_point(view, s, depth));
        i = next_wanted(view, i + items_apart());
    } while (i < texels_of(view));
}
