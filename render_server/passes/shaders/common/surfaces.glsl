// Declared specular surfaces of the real scene (scene document, real.surfaces).
struct SurfaceEntry {
    vec4 f0;        // rgb reflectance at normal incidence, w: metallic
    vec4 surface;   // roughness
    vec4 albedo;    // rgb, w: 1 if declared
    vec4 region[2]; // see render_server/scene/declared_surfaces.py; kind in region[0].w
};
layout(std430) readonly buffer Surfaces { SurfaceEntry surfaces[]; };
uniform int surface_count;

const float PLANE = 0.0, BOX = 1.0, MATERIAL = 2.0, SHEET = 3.0;

vec3 sheet_normal(SurfaceEntry e) { return e.f0.xyz; }

float sheet_height(SurfaceEntry e, vec3 p) { return dot(p - e.region[0].xyz, sheet_normal(e)); }

// Rectangle of paper, in which everything is diffuse.
bool on_sheet(SurfaceEntry e, vec3 p) {
    vec3 from = p - e.region[0].xyz, edge = e.region[1].xyz;
    vec3 along = abs(vec3(dot(from, edge), dot(from, cross(sheet_normal(e), edge)), sheet_height(e, p)));
    return all(lessThanEqual(along, vec3(e.region[1].w, e.f0.w, e.surface.y)));
}

float plane_height(SurfaceEntry e, vec3 p) { return dot(p - e.region[0].xyz, e.region[1].xyz); }

bool in_region(SurfaceEntry e, vec3 p, float material) {
    float kind = e.region[0].w;
    if (kind == PLANE) return abs(plane_height(e, p)) <= e.region[1].w;
    if (kind == MATERIAL) return e.region[0].x == material;
    if (kind == SHEET) return on_sheet(e, p);
    return all(greaterThanEqual(p, e.region[0].xyz)) && all(lessThanEqual(p, e.region[1].xyz));
}

// First entry whose region contains the world point, -1 for diffuse. `material`: index in the given model, -2 for
// none.
int surface_entry(vec3 p, float material) {
    for (int i = 0; i < surface_count; ++i)
        if (in_region(surfaces[i], p, material)) return surfaces[i].region[0].w == SHEET ? -1 : i;
    return -1;
}
