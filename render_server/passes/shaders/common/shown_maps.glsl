// What maps give at a pixel, packed by the geometry buffer in place of texture coordinate and vertex colour: all maps are sampled
// there, once, with the footprint that the picture has. Values are relative to the material's own.
#include "common/materials.glsl"
#include "common/packing.glsl"

#ifdef MATERIAL_MAPS
struct ShownMaps { vec3 base; float metallic; float roughness; float occlusion; vec3 glow; };

const float STEPS = 4095.0;   // of roughness and of occlusion: both fit a float exactly

// Roots of colours: even steps to the eye.
void pack_maps(ShownMaps s, out vec2 uv, out vec4 tint) {
    uv = vec2(round(s.roughness * STEPS) + (STEPS + 1.0) * round(s.occlusion * STEPS), pack_color(sqrt(s.glow)));
    tint = vec4(sqrt(s.base), s.metallic);
}

ShownMaps unpack_maps(vec2 uv, vec4 tint) {
    float occlusion = floor(uv.x / (STEPS + 1.0));
    vec3 glow = unpack_color(uv.y);
    return ShownMaps(tint.rgb * tint.rgb, tint.a, (uv.x - (STEPS + 1.0) * occlusion) / STEPS, occlusion / STEPS, glow * glow);
}

// An image, because OpenGL guarantees no more than sixteen samplers.
layout(rg32f) readonly uniform image2D virtual_raster_uv;

#ifdef COATED
#include "common/octahedral.glsl"
layout(rgba32f) readonly uniform image2D virtual_raster_coating;

// Coat and sheen with their maps; the coat's normal to the last bit, for mirror images.
vec4 pack_coating(Coating over) {
    float amounts = pack_color(vec3(over.coat, over.roughness, over.sheen_roughness));
    return vec4(amounts, pack_color(sqrt(over.sheen)), octahedral_uv(over.normal));
}

Coating unpack_coating(vec4 packed_values) {
    vec3 amounts = unpack_color(packed_values.x), sheen = unpack_color(packed_values.y);
    return Coating(amounts.x, amounts.y, octahedral_direction(packed_values.zw), sheen * sheen, amounts.z);
}

Coating coating_at(ivec2 raster, int material) { return unpack_coating(imageLoad(virtual_raster_coating, raster)); }
#endif

ShownMaps maps_at(ivec2 raster, vec4 tint) { return unpack_maps(imageLoad(virtual_raster_uv, raster).xy, tint); }

float roughness_at(ivec2 raster, int material) {
    return materials[material].dielectric.a * maps_at(raster, vec4(0.0)).roughness;
}

Material material_at(ivec2 raster, int material, vec4 tint) {
    ShownMaps s = maps_at(raster, tint);
    MaterialEntry e = materials[material];
    Material m = mapped(e, e.base_color.rgb * s.base, s.metallic, s.roughness, s.occlusion, s.glow);
#ifdef COATED
    m.over = coating_at(raster, material);
#endif
    return m;
}
#else
#ifdef COATED
Coating coating_at(ivec2 raster, int material) { return plain_coating(materials[material]); }
#endif

float roughness_at(ivec2 raster, int material) { return materials[material].dielectric.a; }

Material material_at(ivec2 raster, int material, vec4 tint) { return material_of(material, vec2(0.0), tint.rgb, 0.0); }
#endif
