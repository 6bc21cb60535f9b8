// Meshes as the camera sees them, through the raster pinhole.
#include "common/camera.glsl"
uniform mat4 clip_from_camera;
in vec3 in_position;
in vec3 in_normal;
in vec2 in_uv;
in vec3 in_color;
in float in_material;
#ifndef MATERIAL_MAPS
#pragma switch MATERIAL_MAPS
#else
in vec2 in_second_uv;   // zero for meshes without
in vec4 in_tangent;     // as well
out vec2 second_uv;
out vec4 tangent;
#endif
out vec3 world;
out vec3 normal;
out vec2 uv;
out vec3 tint;
out float depth;
flat out float material;   // its number
#ifdef CUTOUTS
out float clear;           // half of what the vertex's opacity lacks to 1
#endif

void main() {
    vec4 camera = camera_from_world * vec4(in_position, 1.0);
    world = in_position;
    normal = in_normal;
    uv = in_uv;
    tint = in_color;
    depth = camera.z;
    material = in_material;
#ifdef CUTOUTS
    clear = fract(in_material);
#endif
#ifdef MATERIAL_MAPS
    second_uv = in_second_uv;
    tangent = in_tangent;
#endif
    gl_Position = clip_from_camera * camera;
}
