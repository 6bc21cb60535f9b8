// Radiance of a point of the real scene, from the picture of the camera that sees it; of several cameras the one that
// shows it largest.
#pragma switch SEVERAL_VIEWS
#include "common/camera_image.glsl"
uniform float depth_tolerance;      // relative to depth: how far a point may be from the visible surface
uniform sampler3D albedo_volume;   // of real surfaces that the camera does not see at present
uniform vec4 albedo_cube;           // its lowest corner (world m) and 1 / edge (1/m)
uniform float picture_lod;          // of the linear picture: one sample covers a triangle's pixels

#ifdef SEVERAL_VIEWS
#include "common/measured_views.glsl"
#else
bool camera_sees(vec3 p) {
    vec3 c = (camera_from_world * vec4(p, 1.0)).xyz;
    if (c.z <= 0.0) return false;
    vec2 pixel = picture_pixel(c);
    if (any(lessThan(pixel, vec2(0.0))) || any(greaterThanEqual(pixel, picture_size))) return false;
    float seen = texelFetch(real_surface_position, ivec2(pixel), 0).w;
    return seen > 0.0 && abs(seen - c.z) < depth_tolerance * c.z;
}

// The normal of the visible side of a surface at p.
bool camera_sees(vec3 p, vec3 n) {
    vec3 c = (camera_from_world * vec4(p, 1.0)).xyz;
    return dot(mat3(camera_from_world) * n, c) < 0.0 && camera_sees(p);
}

vec3 measured_radiance(vec3 p) {
    vec3 c = (camera_from_world * vec4(p, 1.0)).xyz;
    return textureLod(linear_picture, picture_pixel(c) / picture_size, picture_lod).rgb;
}
#endif

vec3 unseen_albedo(vec3 p) { return textureLod(albedo_volume, (p - albedo_cube.xyz) * albedo_cube.w, 0.0).rgb; }
