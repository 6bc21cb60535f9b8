// One tile of a reflective shadow map: the scene as a light sees it.
#include "common/lights.glsl"
uniform int view_index;
in vec3 in_position;
in vec3 in_normal;
in vec2 in_uv;
in vec3 in_color;
in float in_material;
out vec3 normal;
out vec2 uv;
out vec3 tint;
flat out float material;

void main() {
    LightView view = light_views[view_index];
    vec3 v = (view.view_from_world * vec4(in_position, 1.0)).xyz;
    float near = view.range.x, far = view.range.y, extent = view.tile.w;
    gl_ClipDistance[0] = dot(view.front, vec4(in_position, 1.0));
    normal = in_normal;
    uv = in_uv;
    tint = in_color;
    material = in_material;
    if (view.range.z > 0.5) gl_Position = vec4(v.xy / extent, 2.0 * (v.z - near) / (far - near) - 1.0, 1.0);
    else gl_Position = vec4(v.xy / extent, ((far + near) * v.z - 2.0 * far * near) / (far - near), v.z);
}
