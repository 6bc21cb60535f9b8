// World position + depth along the optical axis, normal + material, texture coordinate.
#include "passes/common/materials.glsl"
uniform vec3 camera_position;
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
    vec3 n = normalize(normal);
    vec3 view = camera_position - world;
    // An interpolated normal may lean away at a silhouette: bend it back into view.
    float away = dot(n, normalize(view));
    bool double_sided = materials[int(material)].flags.x > 0.5;
    if (away < 0.0) n = double_sided ? -n : normalize(n - (away - 0.01) * normalize(view));
    out_position = vec4(world, depth);
    out_normal = vec4(n, material);
    out_uv = uv;
    out_tint = vec4(tint, 1.0);
}
