// The camera's view of the real scene: linear picture, geometry buffer, and projection of world points into it.
#include "common/camera.glsl"
#include "common/geometry.glsl"
uniform sampler2D linear_picture;   // B_lin, camera units; a = 0 where a channel is clipped
#pragma texels rgba16f linear_picture

// Pixel (centres at .5 for texelFetch) of a camera-space point.
vec2 picture_pixel(vec3 c) { return camera_pinhole.xy * c.xy / c.z + camera_pinhole.zw + 0.5; }
