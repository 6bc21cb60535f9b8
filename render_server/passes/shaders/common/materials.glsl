// Materials of meshes. MATERIAL_MAPS: some have maps or alpha (scene/materials.py): two arrays of textures with mip levels.
// EXTENDED: a coat or a sheen lies over some (common/coating.glsl), or maps tell what their dielectric part reflects and lets through.
#include "common/interleaved_gradient_noise.glsl"
#pragma switch EXTENDED
#ifndef MATERIAL_MAPS
#pragma switch MATERIAL_MAPS
#else
struct MapEntry {
    vec4 u;          // texture coordinate: dot(u.xyz, (uv, 1)); layer, -1 without a map
    vec4 v;          // the same; set of the vertices' coordinates
    vec4 sampling;   // wraps (across + 3 down); columns, rows of an unfiltered texture, else 0; strength
};
#endif
#ifdef EXTENDED
const int MAP_COUNT = 13;

// What lies over a base; `normal` is the coat's own, zero if it has the surface's.
struct Coating { float coat; float roughness; vec3 normal; vec3 sheen; float sheen_roughness; };
#else
const int MAP_COUNT = 5;
#endif
struct MaterialEntry {
    vec4 base_color;   // rgb linear; metallic
    vec4 dielectric;   // F0 rgb; roughness
    vec4 emission;     // rgb radiance, camera units; transmission
    vec4 flags;        // 1: double-sided, -1: not to be seen from behind; row + 1 of the measured, layer + 1 of a texture by light, 0: none; layers of a stack, -1: unlit
    vec4 medium;       // absorption, 1/m rgb; index of refraction, 0: thin
#ifdef EXTENDED
    vec4 coat;         // fraction under the coat, its roughness; the sheen's
    vec4 sheen;        // rgb
#endif
#ifdef MATERIAL_MAPS
    vec4 alpha;        // mode, alpha, repeats of the base colour's map per m, cutoff where vertices' alpha is masked, else 0
    MapEntry maps[MAP_COUNT];
#endif
};
layout(std430) readonly buffer Materials { MaterialEntry materials[]; };

bool is_two_sided(int index) { return materials[index].flags.x > 0.5; }
bool hides_back(int index) { return materials[index].flags.x < -0.5; }

// An unlit surface glows with its base colour, which the vertex colour multiplies.
vec3 glow_tint(MaterialEntry e, vec3 tint) { return e.flags.w < 0.0 ? tint : vec3(1.0); }

#ifdef EXTENDED
Coating plain_coating(MaterialEntry e) { return Coating(e.coat.x, e.coat.y, vec3(0.0), e.sheen.rgb, e.coat.z); }
#endif

// Of a Material: `passing` is the fraction of the light entering the surface that goes on through it, `diffuse` what of
// the rest comes back.
#ifdef MATERIAL_MAPS
uniform sampler2DArray color_maps;   // linear; a: alpha, of a mask the fraction that is there
uniform sampler2DArray data_maps;

const int BASE_COLOR = 0, METALLIC_ROUGHNESS = 1, NORMAL = 2, OCCLUSION = 3, EMISSIVE = 4;
#ifdef EXTENDED
const int COAT = 5, COAT_ROUGHNESS = 6, COAT_NORMAL = 7, SHEEN = 8, SHEEN_ROUGHNESS = 9;
const int SPECULAR = 10, SPECULAR_COLOR = 11, TRANSMITTED = 12;
#endif
const int MIRRORED = 2;   // of wraps: 0 repeats, 1 clamps
const float MASKED = 1.0, BLENDED = 2.0;   // modes of alpha
const float MASK_SLOPE = 8.0;              // of coverage over alpha (scene/materials.py)
const float APART = 5.588238;              // of the noise of materials and sides: what lies behind is left out elsewhere
const float COARSEST = 32.0;   // mip level: a texture's mean

struct Material {
    vec3 diffuse; vec3 f0; float roughness; vec3 emission; float occlusion; vec3 passing;
#ifdef EXTENDED
    Coating over;
#endif
#ifdef MEASURED
    int measured;   // row, -1: none
    int layers;     // of a stack, 0: none
    vec4 stack;     // place on a texture by light; its first layer, mip level
    bool is_polynomial;
    vec3 polynomial[6];   // of the light's direction along the next two
    vec3 rightwards;
    vec3 upwards;
#endif
};

Material mapped(MaterialEntry e, vec3 base, float metallic, float roughness, float occlusion, vec3 glow) {
    metallic *= e.base_color.a;
    vec3 f0 = mix(e.dielectric.rgb, base, metallic);
    vec3 entering = base * (1.0 - metallic);
    Material m;
    m.diffuse = entering * (1.0 - e.emission.a);
    m.f0 = f0;
    m.roughness = e.dielectric.a * roughness;
    m.emission = e.emission.rgb * glow;
    m.occlusion = occlusion;
    m.passing = entering * e.emission.a;
#ifdef EXTENDED
    m.over = plain_coating(e);
#endif
#ifdef MEASURED
    m.measured = int(e.flags.y) - 1;
    m.layers = 0;
    m.is_polynomial = false;
    if (e.flags.z > 0.0) {   // their place holds something else (textures_by_light.glsl)
        m.occlusion = 1.0;
        m.roughness = e.dielectric.a;
    }
#endif
    return m;
}

bool has_map(MapEntry m) { return m.u.w >= 0.0; }

vec2 place_on(MapEntry m, vec2 uv) { return vec2(dot(m.u.xyz, vec3(uv, 1.0)), dot(m.v.xyz, vec3(uv, 1.0))); }

// A coordinate within the texture; `margin`: half a texel, within which filters would reach over the edge.
float wrapped(float x, int wrap, float margin) {
    if (wrap == MIRRORED) x = 1.0 - abs(mod(x, 2.0) - 1.0);
    return wrap == 0 ? x : clamp(x, margin, 1.0 - margin);
}

vec3 layer_place(MapEntry m, vec2 place, float margin) {
    int wraps = int(m.sampling.x);
    vec2 at = vec2(wrapped(place.x, wraps % 3, margin), wrapped(place.y, wraps / 3, margin));
    if (m.sampling.y > 0.0) at = (floor(at * m.sampling.yz) + 0.5) / m.sampling.yz;
    return vec3(at, m.u.w);
}

// Where there is no picture to tell the footprint: the texels of a mip level. What lies on the second set of coordinates, which
// rays and voxels do not know, is its mean.
vec4 map_level(sampler2DArray maps, MapEntry m, vec2 uv, float level) {
    if (!has_map(m)) return vec4(1.0);
    vec3 at = layer_place(m, place_on(m, uv), 0.5 / float(textureSize(maps, 0).x));
    return textureLod(maps, at, m.v.w > 0.5 ? COARSEST : level);
}

// Mip level at which a texel is as large as `size` (m).
float level_of(MaterialEntry e, sampler2DArray maps, float size) {
    return log2(max(size * e.alpha.z * float(textureSize(maps, 0).x), 1.0));
}

#ifdef EXTENDED
// With what maps give of the reflectance at normal incidence, and of transmission.
MaterialEntry with_dielectric(MaterialEntry e, vec3 f0, float transmission) {
    e.dielectric.rgb *= f0;
    e.emission.a *= transmission;
    return e;
}
#endif

// What maps give of a material, relative to its own; 1 without.
struct MapValues {
    vec3 base; vec3 glow; float occlusion; float roughness; float metallic;
#ifdef EXTENDED
    vec3 f0; float transmission; Coating over;
#endif
};

// Numbers of the maps of each array, as bits.
#ifdef EXTENDED
const uint COLOR_MAPS = 1u << BASE_COLOR | 1u << EMISSIVE | 1u << SHEEN | 1u << SHEEN_ROUGHNESS | 1u << SPECULAR | 1u << SPECULAR_COLOR;
const uint DATA_MAPS = 1u << METALLIC_ROUGHNESS | 1u << COAT | 1u << COAT_ROUGHNESS | 1u << TRANSMITTED;
#else
const uint COLOR_MAPS = 1u << BASE_COLOR | 1u << EMISSIVE;
const uint DATA_MAPS = 1u << METALLIC_ROUGHNESS;
#endif

// Those of `maps` that a material has. Loops over them, which drivers do not unroll, look each up by one call: drivers compile every
// call anew, and llvmpipe makes many instructions of one.
uint maps_of(int index, uint maps) {
    uint had = 0u;
    for (uint left = maps; left != 0u; left &= left - 1u)
        if (has_map(materials[index].maps[findLSB(left)])) had |= 1u << findLSB(left);
    return had;
}

MapValues no_maps() {
    MapValues s;
    s.base = s.glow = vec3(1.0);
    s.occlusion = s.roughness = s.metallic = 1.0;
#ifdef EXTENDED
    s.f0 = vec3(1.0);
    s.transmission = 1.0;
    s.over = Coating(1.0, 1.0, vec3(0.0), vec3(1.0), 1.0);
#endif
    return s;
}

void take_color(inout MapValues s, int map, vec4 value) {
    if (map == BASE_COLOR) s.base = value.rgb;
    if (map == EMISSIVE) s.glow = value.rgb;
#ifdef EXTENDED
    if (map == SHEEN) s.over.sheen = value.rgb;
    if (map == SHEEN_ROUGHNESS) s.over.sheen_roughness = value.a;
    if (map == SPECULAR) s.f0 *= value.a;
    if (map == SPECULAR_COLOR) s.f0 *= value.rgb;
#endif
}

void take_data(inout MapValues s, int map, vec4 value) {
    if (map == OCCLUSION) s.occlusion = value.r;
    if (map == METALLIC_ROUGHNESS) { s.roughness = value.g; s.metallic = value.b; }
#ifdef EXTENDED
    if (map == COAT) s.over.coat = value.r;
    if (map == COAT_ROUGHNESS) s.over.roughness = value.g;
    if (map == TRANSMITTED) s.transmission = value.r;
#endif
}

#ifdef EXTENDED
// The material's own, times what maps give.
Coating mapped_coating(MaterialEntry e, Coating maps) {
    return Coating(e.coat.x * maps.coat, e.coat.y * maps.roughness, vec3(0.0), e.sheen.rgb * maps.sheen, e.coat.z * maps.sheen_roughness);
}
#endif

MapValues values_of_maps(int index, vec2 uv, float color_level, float data_level) {
    MapValues s = no_maps();
#ifdef EXTENDED
    for (uint left = maps_of(index, COLOR_MAPS); left != 0u; left &= left - 1u)
        take_color(s, findLSB(left), map_level(color_maps, materials[index].maps[findLSB(left)], uv, color_level));
    for (uint left = maps_of(index, DATA_MAPS); left != 0u; left &= left - 1u)
        take_data(s, findLSB(left), map_level(data_maps, materials[index].maps[findLSB(left)], uv, data_level));
#else   // so few that a loop would gain nothing
    MaterialEntry e = materials[index];
    take_color(s, BASE_COLOR, map_level(color_maps, e.maps[BASE_COLOR], uv, color_level));
    take_color(s, EMISSIVE, map_level(color_maps, e.maps[EMISSIVE], uv, color_level));
    take_data(s, METALLIC_ROUGHNESS, map_level(data_maps, e.maps[METALLIC_ROUGHNESS], uv, data_level));
#endif
    return s;
}

// `tint`: the vertex colour, which multiplies the base colour. `size`: of the footprint, m.
Material material_of(int index, vec2 uv, vec3 tint, float size) {
    MaterialEntry e = materials[index];
    MapValues s = values_of_maps(index, uv, level_of(e, color_maps, size), level_of(e, data_maps, size));
    vec3 base = e.base_color.rgb * tint * s.base, glow = glow_tint(e, tint) * s.glow;
#ifdef EXTENDED
    e = with_dielectric(e, s.f0, s.transmission);
#endif
    Material m = mapped(e, base, s.metallic, s.roughness, 1.0, glow);
#ifdef EXTENDED
    m.over = mapped_coating(e, s.over);
#endif
    return m;
}

// Vertices hold their opacity beside the material's number, as a fraction (scene/gpu_mesh.py).
float opacity_of_vertices(float clear) { return 1.0 - 2.0 * clear; }

// Maps of a mask hold coverage already, unless vertices' alpha multiplies them: then this makes it, one half at the cutoff.
float fraction_there(MaterialEntry e, float alpha) {
    return e.alpha.w == 0.0 ? alpha : clamp(0.5 + MASK_SLOPE * (alpha - e.alpha.w), 0.0, 1.0);
}

// Fraction of a footprint that is there; `of_vertices`: their opacity.
float opacity_of(int index, vec2 uv, float of_vertices, float size) {
    MaterialEntry e = materials[index];
    if (e.alpha.x == 0.0) return 1.0;
    vec4 texel = map_level(color_maps, e.maps[BASE_COLOR], uv, level_of(e, color_maps, size));
    return fraction_there(e, of_vertices * e.alpha.y * texel.a);
}

// Whether a place of that opacity is left out: below a mask's half; where blended, below `even`, which takes all values 0..1.
bool is_cut_out(int index, float opacity, float even) {
    float mode = materials[index].alpha.x;
    return mode != 0.0 && (mode == MASKED ? opacity < 0.5 : opacity <= even);
}

#else
struct Material {
    vec3 diffuse; vec3 f0; float roughness; vec3 emission; vec3 passing;
#ifdef EXTENDED
    Coating over;
#endif
#ifdef MEASURED
    int measured;
#endif
};

// `tint`: the vertex colour, which multiplies the base colour. `size` (of a footprint, m) and `uv` are for maps.
Material material_of(int index, vec2 uv, vec3 tint, float size) {
    MaterialEntry e = materials[index];
    vec3 base = e.base_color.rgb * tint;
    Material m;
    vec3 entering = base * (1.0 - e.base_color.a);
    m.diffuse = entering * (1.0 - e.emission.a);
    m.passing = entering * e.emission.a;
    m.f0 = mix(e.dielectric.rgb, base, e.base_color.a);
    m.roughness = e.dielectric.a;
    m.emission = e.emission.rgb * glow_tint(e, tint);
#ifdef EXTENDED
    m.over = plain_coating(e);
#endif
#ifdef MEASURED
    m.measured = int(e.flags.y) - 1;
#endif
    return m;
}
#endif
