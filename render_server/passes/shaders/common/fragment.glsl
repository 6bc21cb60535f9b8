// A fragment of a mesh that a camera sees, and what the geometry buffer holds of it. A rasterizer interpolates it, or it lies where a
// ray meets a triangle (common/mesh_fragment.glsl).
#include "common/shown_maps.glsl"
#include "common/camera.glsl"
#pragma switch CUTOUTS
#pragma switch PACKS_EXTENDED
#pragma switch MEASURED

struct Fragment {
    vec3 world;
    float depth;     // along the optical axis
    vec3 normal;     // interpolated; zero in a fold
    vec3 face;       // the triangle's own normal, towards the camera
    vec2 uv;
    vec3 tint;
    int material;
    bool is_back;    // seen from behind
#ifdef CUTOUTS
    float opacity;   // of its vertices
#endif
#ifdef MATERIAL_MAPS
    vec2 second_uv;
    vec4 tangent;    // the file's; zero without. w: sign of (normal x tangent) along a normal map's y
    // What a pixel to the right (xy) and one down (zw) add; the same of the place.
    vec4 uv_slopes;
    vec4 second_uv_slopes;
    vec3 right;
    vec3 down;
#endif
};

struct Surface {   // as the geometry buffer's textures
    vec4 position; vec4 normal; vec2 uv; vec4 tint;
#ifdef PACKS_EXTENDED
    uvec4 extended;
#endif
};

#ifdef MATERIAL_MAPS
#include "common/fragment_maps.glsl"
#ifdef MEASURED
#include "common/basis.glsl"
#include "common/textures_by_light.glsl"

// A stack leaves `roughness`, which it has in common with other surfaces.
vec2 place_on_texture(Fragment f, vec3 n, float roughness) {
    vec3 rightwards, upwards;
    map_axes(f, slopes_of(f, materials[f.material].maps[BASE_COLOR]), rightwards, upwards);
    return vec2(is_stack(f.material) ? roughness : pack_turn(n, rightwards, upwards), pack_place(f.uv));
}
#endif
#endif

#ifdef CUTOUTS
// `place`: of the raster's texel. `blend_sample` 0..1: samples of one pixel show different parts of what is blended.
bool is_left_out(Fragment f, vec2 place, float blend_sample) {
    float layer = 2.0 * float(f.material) + float(f.is_back);
    float even = fract(interleaved_gradient_noise(place + APART * layer) + blend_sample);
    return is_cut_out(f.material, fragment_opacity(f), even);
}
#endif

// An interpolated normal may vanish in a fold, or face away at a silhouette: then use the triangle's own.
vec3 facing_normal(Fragment f, vec3 view) {
    vec3 n = f.normal == vec3(0.0) ? f.face : normalize(f.normal);
    return dot(n, view) >= 0.0 ? n : (is_two_sided(f.material) ? -n : f.face);
}

// `shows`: whether a pixel will show it; otherwise texture coordinate and colour are not needed.
Surface surface_at(Fragment f, bool shows) {
    vec3 view = camera_position - f.world, n = facing_normal(f, view);
    vec2 uv = f.uv;
    vec4 tint = vec4(f.tint, 1.0);
#ifdef MATERIAL_MAPS
    MapValues maps = fragment_values(f, shows);
#endif
#ifdef PACKS_EXTENDED
    Extended extended = Extended(mapped_coating(materials[f.material], maps.over), maps.f0, maps.transmission);
    extended.over.normal = bent_normal(f, materials[f.material].maps[COAT_NORMAL], n, normalize(view));
#endif
#ifdef MATERIAL_MAPS
    n = bent_normal(f, materials[f.material].maps[NORMAL], n, normalize(view));
    pack_maps(shown_maps(f, maps), uv, tint);
#ifdef MEASURED
    if (is_by_light(f.material)) uv = place_on_texture(f, n, uv.x);
#endif
#endif
    Surface s;
    s.position = vec4(f.world, f.depth);
    s.normal = vec4(n, float(f.material));
    s.uv = uv;
    s.tint = tint;
#ifdef PACKS_EXTENDED
    s.extended = pack_extended(extended);
#endif
    return s;
}
