// World position + depth along the optical axis, normal + material, texture coordinate.
#include "common/materials.glsl"
#include "common/camera.glsl"
in vec3 world;
in vec3 normal;
in vec2 uv;
in vec3 tint;
in float depth;
flat in float material;
layout(location = 0) out vec4 out_position;
layout(location = 1) out vec4 out_normal;
layout(location = 2) out vec2 out_uv;
layout(location = 3) out vec4 out_tint;

void main() {
    vec3 view = camera_position - world;
    // An interpolated normal may vanish in a fold, or face away at a silhouette: then use the triangle's own.
    vec3 across = cross(dFdx(world), dFdy(world));
    vec3 flat_normal = normalize(across == vec3(0.0) ? view : across);
    if (dot(flat_normal, view) < 0.0) flat_normal = -flat_normal;
    vec3 n = normal == vec3(0.0) ? flat_normal : normalize(normal);
    bool double_sided = materials[int(material)].flags.x > 0.5;
    if (dot(n, view) < 0.0) n = double_sided ? -n : flat_normal;
    out_position = vec4(world, depth);
    out_normal = vec4(n, material);
    out_uv = uv;
    out_tint = vec4(tint, 1.0);
}
