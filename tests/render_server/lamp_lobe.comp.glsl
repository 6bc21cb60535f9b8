// Highlights of lamps in a white metal: x as shading has them (specular_times_cosine), y the mean of what points of the lamp's disc give.
#include "common/brdf.glsl"

layout(local_size_x = 64) in;
struct Highlight { vec4 view_roughness; vec4 light_radius; };   // about the normal z
layout(std430) readonly buffer Highlights { Highlight highlights[]; };
layout(std430) writeonly buffer Found { vec2 found[]; };
uniform int count;

const int POINTS = 4096;

float of_point(vec3 v, vec3 l, float roughness, float radius) {
    return specular_times_cosine(vec3(0.0, 0.0, 1.0), v, l, vec3(1.0), roughness, vec2(radius, 0.0)).r;
}

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= uint(count)) return;
    vec3 v = highlights[i].view_roughness.xyz, l = highlights[i].light_radius.xyz;
    float roughness = highlights[i].view_roughness.w, radius = highlights[i].light_radius.w, sum = 0.0;
    mat3 basis = basis_around(l);
    for (int j = 0; j < POINTS; ++j) {
        float z = 1.0 - (1.0 - cos(radius)) * (float(j) + 0.5) / float(POINTS), phi = float(j) * GOLDEN_ANGLE;
        sum += of_point(v, basis * vec3(sqrt(1.0 - z * z) * vec2(cos(phi), sin(phi)), z), roughness, 0.0);
    }
    float across = sin(radius) * sin(radius) / (2.0 * (1.0 - cos(radius)));   // irradiance of the disc across the beam over its solid angle
    found[i] = vec2(of_point(v, l, roughness, radius), sum / (float(POINTS) * across));
}
