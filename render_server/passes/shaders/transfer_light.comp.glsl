// Light at the vertices of an object by their precomputed transfer ([D] 4.3.1, docs/method.md 6.5): irradiance, and how much of what
// the vertex mirrors to the viewer the object leaves open.
#include "common/harmonics.glsl"

layout(local_size_x = 64) in;
layout(std430) readonly buffer Transfer { uvec2 transfer[]; };        // a vertex's coefficients follow each other; R G B, occlusion
layout(std430) readonly buffer TransferVertices { float vertices[]; };   // position, normal (asset's frame)
layout(std430) writeonly buffer VertexLight { vec4 vertex_light[]; };
uniform vec3 light_coefficients[16];   // asset's frame
uniform int coefficient_count;
uniform int vertex_count;
uniform vec3 viewer;                   // asset's frame

vec3 at(int offset) { return vec3(vertices[offset], vertices[offset + 1], vertices[offset + 2]); }

void main() {
    int vertex = int(gl_GlobalInvocationID.x);
    if (vertex >= vertex_count) return;
    float basis[HARMONICS];
    harmonics(normalize(reflect(at(6 * vertex) - viewer, at(6 * vertex + 3))), basis);
    vec4 sum = vec4(0.0);
    for (int k = 0; k < coefficient_count; ++k) {
        uvec2 halves = transfer[coefficient_count * vertex + k];
        vec4 t = vec4(unpackHalf2x16(halves.x), unpackHalf2x16(halves.y));
        sum += t * vec4(light_coefficients[k], basis[k]);
    }
    vertex_light[vertex] = vec4(max(sum.rgb, vec3(0.0)), clamp(1.0 - sum.a, 0.0, 1.0));
}
