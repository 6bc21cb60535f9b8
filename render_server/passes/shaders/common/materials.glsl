// Materials of meshes: a table, with base colour from one texture atlas layer where the mesh has one.
struct MaterialEntry {
    vec4 base_color;   // rgb linear; metallic
    vec4 dielectric;   // F0 rgb; roughness
    vec4 emission;     // rgb radiance, camera units; transmission
    vec4 flags;        // double-sided, texture layer or -1
};
layout(std430) readonly buffer Materials { MaterialEntry materials[]; };
uniform sampler2DArray base_color_textures;

struct Material { vec3 diffuse; vec3 f0; float roughness; vec3 emission; };

// `tint`: the vertex colour, which multiplies the base colour.
Material material_of(int index, vec2 uv, vec3 tint) {
    MaterialEntry e = materials[index];
    vec3 base = e.base_color.rgb * tint;
    if (e.flags.y >= 0.0) base *= textureLod(base_color_textures, vec3(uv, e.flags.y), 0.0).rgb;
    Material m;
    m.diffuse = base * (1.0 - e.base_color.a);
    m.f0 = mix(e.dielectric.rgb, base, e.base_color.a);
    m.roughness = e.dielectric.a;
    m.emission = e.emission.rgb;
    return m;
}
