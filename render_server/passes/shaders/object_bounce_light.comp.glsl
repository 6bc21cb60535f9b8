// Light that an object reflects onto its surroundings (radiance transfer field, [D] 5.2.4). LIGHT: the incident
// light, nine coefficients: its surroundings, and each lamp that is visible from the middles of its box's eighths.
// Otherwise: each sample's transfer times that light.
#include "common/light_probe.glsl"
#include "common/object_field.glsl"
#ifdef LIGHT
#include "common/lights.glsl"
#include "common/harmonics.glsl"
#endif

const int LENGTH = 9;   // coefficients of incident and of reflected light
#ifdef LIGHT
layout(local_size_x = 16) in;
uniform sampler2D probe;
layout(std430) writeonly buffer Incident { vec4 incident[]; };

vec3 from_lamps(int k) {
    vec3 sum = vec3(0.0);
    for (int i = 0; i < 8 * light_count; ++i) {
        vec3 eighth = vec3(i & 1, (i >> 1) & 1, (i >> 2) & 1) - 0.5;
        vec3 p = object_position + world_from_object * (object_scale * (field_centre + eighth * object_half)), l;
        float radius;
        vec3 e_perp = light_at(listed_light(i / 8), p, l, radius);
        float b[HARMONICS];
        harmonics(turn_to_object(l), b);
        sum += e_perp * (b[k] * visibility(listed_light(i / 8), p, l, 0.0, 0.0).x / 8.0);
    }
    return sum;
}

void main() {
    int k = int(gl_GlobalInvocationID.x);
    if (k >= LENGTH) return;
    vec3 sum = vec3(0.0);
    for (int t = 0; t < PROBE_TEXELS; ++t)
        sum += texel_solid_angle(t) * texel_harmonic(t, k) * texelFetch(probe, ivec2(t % PROBE_SIZE, t / PROBE_SIZE), 0).rgb;
    incident[k] = vec4(sum + from_lamps(k), 0.0);
}
#else
layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image3D bounce_light;            // a slab per coefficient
layout(std430) readonly buffer Transfer { uint transfer[]; };     // half floats: sample, sent, light, RGB
layout(std430) readonly buffer Incident { vec4 incident[]; };
uniform vec3 reflectance;

float transfer_at(int place) {
    vec2 two = unpackHalf2x16(transfer[place >> 1]);
    return (place & 1) == 0 ? two.x : two.y;
}

void main() {
    int n = imageSize(bounce_light).x, sample_number = int(gl_GlobalInvocationID.x), k = int(gl_GlobalInvocationID.y);
    if (sample_number >= shells * n * n * n || k >= LENGTH) return;
    vec3 sum = vec3(0.0);
    int first = (sample_number * LENGTH + k) * LENGTH * 3;
    for (int i = 0; i < LENGTH; ++i) {
        int at = first + 3 * i;
        sum += vec3(transfer_at(at), transfer_at(at + 1), transfer_at(at + 2)) * incident[i].rgb;
    }
    int shell = sample_number / (n * n * n), inside = sample_number % (n * n * n);
    ivec3 cell = ivec3(inside % n, (inside / n) % n, inside / (n * n));
    cell.z += n * (shell * LENGTH + k);
    imageStore(bounce_light, cell, vec4(reflectance * sum, 1.0));
}
#endif
