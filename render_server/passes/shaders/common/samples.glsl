// Samples of the objects in a pixel, and where they lie in the raster of the objects.
#include "common/in_front.glsl"
#include "common/camera.glsl"

// In texels, whose centres are at integers.
vec2 place_in_raster(ivec2 pixel) {
    return lens_distortion ? raster_pinhole.xy * texelFetch(picture_rays, pixel, 0).xy + raster_pinhole.zw : vec2(pixel);
}

// Whether a point is off the plane (p, n) by more than a pixel spans there, or faces another way (37 degrees; a smooth surface bends
// less within a pixel).
bool is_another(vec3 p, vec3 n, vec4 position, vec3 normal) {
    return abs(dot(position.xyz - p, n)) > position.w / camera_pinhole.x || dot(normal, n) < 0.8;
}

vec4 covered(bool seen, float depth) { return seen ? vec4(1.0, 0.0, 0.0, 0.0) : vec4(0.0, 1.0, depth, 0.0); }
