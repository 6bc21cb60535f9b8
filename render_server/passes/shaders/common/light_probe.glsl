// Radiance around an object, octahedral in the asset's axes: what the camera sees there, the environment elsewhere.
#include "common/octahedral.glsl"
const int PROBE_SIZE = 32;
const int PROBE_TEXELS = PROBE_SIZE * PROBE_SIZE;
const int PROBE_ROW = 26;   // floats per direction in the table: its solid angle (sr), then 25 harmonics
layout(std430) readonly buffer ProbeTable { float probe_table[]; };

float texel_solid_angle(int texel) { return probe_table[texel * PROBE_ROW]; }
float texel_harmonic(int texel, int k) { return probe_table[texel * PROBE_ROW + 1 + k]; }

// Direction of a texel's centre: the inverse of octahedral_uv.
vec3 texel_direction(int texel) {
    vec2 p = 2.0 * (vec2(texel % PROBE_SIZE, texel / PROBE_SIZE) + 0.5) / float(PROBE_SIZE) - 1.0;
    float z = 1.0 - abs(p.x) - abs(p.y);
    return normalize(vec3(p - max(-z, 0.0) * vec2(p.x >= 0.0 ? 1.0 : -1.0, p.y >= 0.0 ? 1.0 : -1.0), z));
}
