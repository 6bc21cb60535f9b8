// One tile of a reflective shadow map: the scene as a light sees it (LightView of passes/shadow_maps.py). Uniforms tell
// of the view, because OpenGL guarantees no storage blocks to vertex shaders.
uniform mat4 view_from_world;
uniform float half_extent;
uniform vec2 depth_range;   // near, far
uniform bool orthographic;
uniform vec4 front;
in vec3 in_position;
in vec3 in_normal;
in vec2 in_uv;
in vec3 in_color;
in float in_material;
out vec3 normal;
out vec2 uv;
out vec3 tint;
flat out float material;
#ifdef CUTOUTS
out float clear;
#endif

void main() {
    vec3 v = (view_from_world * vec4(in_position, 1.0)).xyz;
    float near = depth_range.x, far = depth_range.y;
    gl_ClipDistance[0] = dot(front, vec4(in_position, 1.0));
    normal = in_normal;
    uv = in_uv;
    tint = in_color;
    material = floor(in_material);
#ifdef CUTOUTS
    clear = fract(in_material);
#endif
    if (orthographic) gl_Position = vec4(v.xy / half_extent, 2.0 * (v.z - near) / (far - near) - 1.0, 1.0);
    else gl_Position = vec4(v.xy / half_extent, ((far + near) * v.z - 2.0 * far * near) / (far - near), v.z);
}
