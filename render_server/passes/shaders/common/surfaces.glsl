// Declared specular surfaces of the real scene (scene document, real.surfaces).
struct SurfaceEntry {
    vec4 f0;        // rgb reflectance at normal incidence, w: metallic
    vec4 surface;   // roughness
    vec4 albedo;    // rgb, w: 1 if declared
    vec4 region[2]; // see render_server/scene/declared_surfaces.py; kind in region[0].w
};
layout(std430) readonly buffer Surfaces { SurfaceEntry surfaces[]; };
uniform int surface_count;

const float PLANE = 0.0, BOX = 1.0, MATERIAL = 2.0;   // kind 3: a box in which everything is diffuse (the marker sheet)

bool in_region(SurfaceEntry e, vec3 p, float material) {
    float kind = e.region[0].w;
    if (kind == PLANE) return abs(dot(p - e.region[0].xyz, e.region[1].xyz)) <= e.region[1].w;
    if (kind == MATERIAL) return e.region[0].x == material;
    return all(greaterThanEqual(p, e.region[0].xyz)) && all(lessThanEqual(p, e.region[1].xyz));
}

// First entry whose region contains the world point, -1 for diffuse. `material`: index in the given model, -2 for
// none.
int surface_entry(vec3 p, float material) {
    for (int i = 0; i < surface_count; ++i)
        if (in_region(surfaces[i], p, material)) return surfaces[i].region[0].w > MATERIAL ? -1 : i;
    return -1;
}
