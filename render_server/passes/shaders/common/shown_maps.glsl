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

#ifdef EXTENDED
#include "common/octahedral.glsl"
layout(rgba32ui) readonly uniform uimage2D virtual_raster_extended;

// Coat and sheen with their maps, and what maps give of f0 and transmission.
struct Extended { Coating over; vec3 f0; float transmission; };

// The coat's roughness has two bytes: the peak of its lobe goes by the inverse fourth power, and eight bits would show.
uvec4 pack_extended(Extended s) {
    uint normal = packUnorm2x16(octahedral_uv(s.over.normal));   // for mirror images
    vec2 rough = unpackUnorm4x8(packUnorm2x16(vec2(s.over.roughness, 0.0))).xy;
    return uvec4(packUnorm4x8(vec4(s.over.coat, rough.y, s.over.sheen_roughness, s.transmission)),
        packUnorm4x8(vec4(sqrt(s.over.sheen), rough.x)), normal, packUnorm4x8(vec4(sqrt(s.f0), 0.0)));
}

Extended extended_at(ivec2 raster) {
    uvec4 codes = imageLoad(virtual_raster_extended, raster);
    vec4 amounts = unpackUnorm4x8(codes.x), sheen = unpackUnorm4x8(codes.y);
    float roughness = unpackUnorm2x16(packUnorm4x8(vec4(sheen.w, amounts.y, 0.0, 0.0))).x;
    vec3 f0 = unpackUnorm4x8(codes.w).rgb;
    vec3 normal = octahedral_direction(unpackUnorm2x16(codes.z));
    return Extended(Coating(amounts.x, roughness, normal, sheen.rgb * sheen.rgb, amounts.z), f0 * f0, amounts.w);
}

Coating coating_at(ivec2 raster, int material) { return extended_at(raster).over; }
#endif

ShownMaps maps_at(ivec2 raster, vec4 tint) { return unpack_maps(imageLoad(virtual_raster_uv, raster).xy, tint); }

float roughness_at(ivec2 raster, int material) {
    return materials[material].dielectric.a * maps_at(raster, vec4(0.0)).roughness;
}

Material material_at(ivec2 raster, int material, vec4 tint) {
    ShownMaps s = maps_at(raster, tint);
    MaterialEntry e = materials[material];
#ifdef EXTENDED
    Extended extended = extended_at(raster);
    e = with_dielectric(e, extended.f0, extended.transmission);
#endif
    Material m = mapped(e, e.base_color.rgb * s.base, s.metallic, s.roughness, s.occlusion, s.glow);
#ifdef EXTENDED
    m.over = extended.over;
#endif
    return m;
}
#else
#ifdef EXTENDED
Coating coating_at(ivec2 raster, int material) { return plain_coating(materials[material]); }
#endif

float roughness_at(ivec2 raster, int material) { return materials[material].dielectric.a; }

Material material_at(ivec2 raster, int material, vec4 tint) { return material_of(material, vec2(0.0), tint.rgb, 0.0); }
#endif
