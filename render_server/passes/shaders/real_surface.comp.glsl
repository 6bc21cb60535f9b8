// World position and normal of the real surface at each pixel, from the clean depth map and its fitted normals
// (render_server/scene/depth_surface.py).
#include "common/measured_surfaces.glsl"
#include "common/fitted_normal.glsl"

#include "common/pixel_group.glsl"
uniform sampler2D depth_map;   // m along the optical axis, 0 unknown
#pragma texels r32f depth_map
layout(rgba32f) writeonly uniform image2D position_out;
layout(rgba16f) writeonly uniform image2D normal_out;
#pragma outputs position_out normal_out

vec3 camera_at(ivec2 pixel, float z) { return vec3(texelFetch(picture_rays, pixel, 0).xy, 1.0) * z; }

vec3 world_at(ivec2 pixel, float z) { return (world_from_camera * vec4(camera_at(pixel, z), 1.0)).xyz; }

#ifdef DECLARED_SURFACES
bool is_plane(int entry) { return entry >= 0 && surfaces[entry].region[0].w == PLANE; }

// Whether the entry is a plane that most of the pixel and its neighbours are off: single ones are outliers of the noise. (llvmpipe
// executes both sides of a branch, but no turn of a loop too many.)
bool leaves_plane(int entry, ivec2 pixel) {
    ivec2 last = textureSize(depth_map, 0) - 1;
    int known = 0, off = 0, count = is_plane(entry) ? 9 : 0;
    SurfaceEntry plane = surfaces[max(entry, 0)];
    vec2 fit = plane_fits[max(entry, 0)];
    for (int j = 0; j < count; ++j) {
        ivec2 at = clamp(pixel + ivec2(j % 3, j / 3) - 1, ivec2(0), last);
        float z = texelFetch(depth_map, at, 0).r;
        known += int(z > 0.0);
        off += int(z > 0.0 && is_off_plane(plane, fit, world_at(at, z), z));
    }
    return 2 * off > known;
}

// `normal`: zero if unknown.
int entry_of(ivec2 pixel, vec3 world, float z, vec3 normal) {
    int entry = -1;
    do entry = measured_entry(entry + 1, world, z, normal, -2.0);
    while (leaves_plane(entry, pixel));
    return entry;
}
#else
int entry_of(ivec2 pixel, vec3 world, float z, vec3 normal) { return -1; }
#endif

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    ivec2 size = textureSize(depth_map, 0);
    if (any(greaterThanEqual(pixel, size))) return;
    float z = texelFetch(depth_map, pixel, 0).r;
    if (z <= 0.0) {
        imageStore(position_out, pixel, vec4(0.0));
        imageStore(normal_out, pixel, vec4(0.0, 0.0, 1.0, -1.0));
        return;
    }
    vec3 world = world_at(pixel, z);
#ifdef FITS_DEPTH
    vec3 fitted = fitted_normal(pixel);
#else
    vec3 fitted = fitted_normal(pixel, 1.0 / z);
#endif
    bool unknown = fitted == vec3(0.0);
    vec3 normal = mat3(world_from_camera) * normalize(unknown ? -camera_at(pixel, z) : fitted);
    imageStore(position_out, pixel, vec4(world, z));
    imageStore(normal_out, pixel, vec4(normal, float(entry_of(pixel, world, z, unknown ? vec3(0.0) : normal))));
}
