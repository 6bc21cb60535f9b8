// Declared surfaces at points that were measured: noise moves a point along its ray, and not all that lies within a
// plane's tolerance belongs to the plane (docs/method.md 4.8).
#pragma switch DECLARED_SURFACES
#include "common/surfaces.glsl"

uniform float noise_sigma;      // m at 1 m
uniform vec2 plane_fits[37];    // of each entry: height of the measured plane over the declared one, m; its noise at 1 m
#include "common/camera.glsl"

const float SIGMAS = 3.0;
const float FLUSH = 0.7071;     // cosine: what leans by more than 45 degrees stands on the plane

// Change of a measured point by one metre of its depth.
vec3 ray_of(vec3 p, float z) { return (p - camera_position) / z; }

// Whether a point stands higher or lower than noise explains. `fit`: the plane's, of plane_fits.
bool is_off_plane(SurfaceEntry plane, vec2 fit, vec3 p, float z) {
    float slope = abs(dot(ray_of(p, z), plane.region[1].xyz));
    return abs(plane_height(plane, p) - fit.x) > SIGMAS * fit.y * z * z * slope;
}

// Where the ray to a point within a plane's tolerance meets the plane.
vec3 on_plane(SurfaceEntry e, vec3 p, vec3 ray) {
    float slope = dot(ray, e.region[1].xyz);
    return abs(slope) > 1e-4 ? p - ray * (plane_height(e, p) / slope) : p;
}

// A point measured at depth z, moved along its ray towards the plane of a sheet, as far as noise explains.
vec3 snapped_to_sheet(SurfaceEntry sheet, vec3 p, vec3 ray, float z) {
    float slope = dot(ray, sheet_normal(sheet)), noise = SIGMAS * noise_sigma * z * z;
    return abs(slope) > 1e-4 ? p - ray * clamp(sheet_height(sheet, p) / slope, -noise, noise) : p;
}

bool is_paper(vec3 p, vec3 ray, float z) {
    for (int i = 0; i < surface_count && surfaces[i].region[0].w == SHEET; ++i)
        if (on_sheet(surfaces[i], snapped_to_sheet(surfaces[i], p, ray, z))) return true;
    return false;
}

// First entry from `first` on that a point measured at depth z may be part of, -1 for diffuse. `normal`: zero if
// unknown.
int measured_entry(int first, vec3 p, float z, vec3 normal, float material) {
    vec3 ray = ray_of(p, z);
    if (is_paper(p, ray, z)) return -1;
    for (int i = first; i < surface_count; ++i) {
        SurfaceEntry e = surfaces[i];
        if (e.region[0].w == SHEET || !in_region(e, p, material)) continue;
        if (e.region[0].w != PLANE) return i;
        if (is_paper(on_plane(e, p, ray), ray, z)) return -1;
        if (normal == vec3(0.0) || abs(dot(normal, e.region[1].xyz)) >= FLUSH) return i;
    }
    return -1;
}
