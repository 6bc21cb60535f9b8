// World position + depth along the optical axis, normal + material, texture coordinate, vertex colour; with MATERIAL_MAPS
// what the maps give in place of the last two. CUTOUTS: some materials have alpha. MEASURED: some go by the light.
#include "common/shown_maps.glsl"
#include "common/camera.glsl"
#pragma switch CUTOUTS
#pragma switch MEASURED
in vec3 world;
in vec3 normal;
in vec2 uv;
in vec3 tint;
in float depth;
flat in float material;
layout(location = 0) out vec4 out_position;
layout(location = 1) out vec4 out_normal;
layout(location = 2) out vec2 out_uv;
layout(location = 3) out vec4 out_tint;
#ifdef MATERIAL_MAPS
in vec2 second_uv;
#include "common/fragment_maps.glsl"
#ifdef MEASURED
#include "common/basis.glsl"
#include "common/textures_by_light.glsl"

// A stack leaves `roughness`, which it has in common with other surfaces.
vec2 place_on_texture(int index, vec3 n, float roughness) {
    vec3 rightwards, upwards;
    map_axes(slopes_of(materials[index].maps[BASE_COLOR]), rightwards, upwards);
    return vec2(is_stack(index) ? roughness : pack_turn(n, rightwards, upwards), pack_place(uv));
}
#endif
#endif
#ifdef CUTOUTS
uniform float blend_sample;   // 0..1: samples of one pixel show different parts of what is blended

bool is_left_out() {
    int index = int(material);
    float layer = 2.0 * material + float(gl_FrontFacing);
    float even = fract(even_noise(gl_FragCoord.xy + APART * layer) + blend_sample);
    return is_cut_out(index, fragment_opacity(index), even);
}
#endif

void main() {
    vec3 view = camera_position - world;
    // An interpolated normal may vanish in a fold, or face away at a silhouette: then use the triangle's own.
    vec3 across = cross(dFdx(world), dFdy(world));
    vec3 flat_normal = normalize(across == vec3(0.0) ? view : across);
    if (dot(flat_normal, view) < 0.0) flat_normal = -flat_normal;
    vec3 n = normal == vec3(0.0) ? flat_normal : normalize(normal);
    bool double_sided = materials[int(material)].flags.x > 0.5;
    if (dot(n, view) < 0.0) n = double_sided ? -n : flat_normal;
#ifdef MATERIAL_MAPS
    find_slopes();
    n = bent_normal(materials[int(material)].maps[NORMAL], n, normalize(view));
    pack_maps(fragment_maps(int(material), tint), out_uv, out_tint);
#ifdef MEASURED
    if (is_by_light(int(material))) out_uv = place_on_texture(int(material), n, out_uv.x);
#endif
#else
    out_uv = uv;
    out_tint = vec4(tint, 1.0);
#endif
#ifdef CUTOUTS
    if (is_left_out()) discard;
#endif
    out_position = vec4(world, depth);
    out_normal = vec4(n, material);
}
