// The camera's view of the real scene: linear picture, geometry buffer, and projection of world points into it.
#include "passes/common/camera_pinhole.glsl"
layout(binding = 8) uniform sampler2D linear_picture;   // B_lin, camera units; a = 0 where a channel is clipped
layout(binding = 9) uniform sampler2D real_position;    // world m; w = depth along the optical axis, 0 unknown
uniform mat4 camera_from_world;
uniform vec2 picture_size;

// Pixel (centres at .5 for texelFetch) of a camera-space point.
vec2 picture_pixel(vec3 c) { return camera_pinhole.xy * c.xy / c.z + camera_pinhole.zw + 0.5; }
