// Normal (+ material index) and texture coordinate of the first surface; depth goes to the depth buffer.
in vec3 normal;
in vec2 uv;
flat in float material;
layout(location = 0) out vec4 out_normal;
layout(location = 1) out vec4 out_uv;

void main() {
    out_normal = vec4(normalize(normal), material);
    out_uv = vec4(uv, 0.0, 1.0);
}
