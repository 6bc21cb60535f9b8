// Normal (+ material index), texture coordinate and vertex colour of the first surface; depth goes to the depth buffer.
#include "common/packing.glsl"

in vec3 normal;
in vec2 uv;
in vec3 tint;
flat in float material;
layout(location = 0) out vec4 out_normal;
layout(location = 1) out vec4 out_uv;

void main() {
    // Vertices' normals may cancel out in a fold: any direction is as good there, NaN is not.
    out_normal = vec4(normal == vec3(0.0) ? vec3(0.0, 0.0, 1.0) : normalize(normal), material);
    out_uv = vec4(uv, pack_color(tint), 1.0);
}
