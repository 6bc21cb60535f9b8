// Declared specular surfaces of the real scene (scene document, real.surfaces).
struct SurfaceEntry {
    vec4 f0;        // rgb reflectance at normal incidence, w: metallic
    vec4 surface;   // roughness
    vec4 albedo;    // rgb, w: 1 if declared
    vec4 region[2]; // plane: point + kind 0, normal + tolerance; box: low + kind 1, high
};
layout(std430, binding = 14) readonly buffer Surfaces { SurfaceEntry surfaces[]; };
uniform int surface_count;

// First entry whose region holds the world point, -1 for none (diffuse).
int surface_entry(vec3 p) {
    for (int i = 0; i < surface_count; ++i) {
        SurfaceEntry e = surfaces[i];
        if (e.region[0].w < 0.5) {
            if (abs(dot(p - e.region[0].xyz, e.region[1].xyz)) <= e.region[1].w) return i;
        } else if (e.region[0].w < 1.5) {
            if (all(greaterThanEqual(p, e.region[0].xyz)) && all(lessThanEqual(p, e.region[1].xyz))) return i;
        }
    }
    return -1;
}
