// What surfaces reflect of radiance 1 from everywhere: x by the lights' formulas, integrated over all directions, y by
// those for gathered light, z by what voxels and cells reflect of it, w by the lobe alone of a lamp wider than it, integrated over
// all places of the lamp.
#include "common/brdf.glsl"
#include "common/lobe.glsl"

layout(local_size_x = 64) in;
struct Surface { vec4 diffuse_cosine; vec4 f0_roughness; };
layout(std430) readonly buffer Surfaces { Surface surfaces[]; };
layout(std430) writeonly buffer Found { vec4 found[]; };
uniform int count;

const int SIDE = 96;   // samples of the lobe, and of the hemisphere, each SIDE^2

float specular_sample(vec2 u, vec3 v, vec3 f0, float roughness) {
    float alpha = max(roughness * roughness, 2e-3);
    vec3 h = visible_normal(u, v, alpha), l = reflect(-v, h);
    if (l.z <= 0.0) return 0.0;
    float masked = 2.0 * v.z / (v.z + sqrt(alpha * alpha + (1.0 - alpha * alpha) * v.z * v.z));
    float density = masked * ggx_distribution(h.z, alpha) / (4.0 * v.z);
    return specular_times_cosine(vec3(0.0, 0.0, 1.0), v, l, f0, roughness, vec2(0.0)).r / density;
}

const float LAMP = 0.15;     // rad, half-angle of the lamp
const float REACH = 1.2;     // rad, around the mirrored direction: what the tails beyond hold is less than 1 %

float shown_of_lamps(vec3 v, vec3 f0, float roughness) {
    vec3 n = vec3(0.0, 0.0, 1.0);
    mat3 basis = basis_around(reflect(-v, n));
    float sum = 0.0, most = 1.0 - cos(REACH);
    for (int j = 0; j < SIDE * SIDE; ++j) {
        float u = (float(j / SIDE) + 0.5) / float(SIDE), z = 1.0 - most * u * u, phi = 2.0 * PI * (float(j % SIDE) + 0.5) / float(SIDE);
        vec3 l = basis * vec3(sqrt(1.0 - z * z) * vec2(cos(phi), sin(phi)), z);
        sum += 2.0 * u * specular_times_cosine(n, v, l, f0, roughness, vec2(LAMP, 0.0)).r;
    }
    return sum * 2.0 * PI * most / float(SIDE * SIDE);
}

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= uint(count)) return;
    float diffuse = surfaces[i].diffuse_cosine.r, cosine = surfaces[i].diffuse_cosine.a;
    vec3 f0 = surfaces[i].f0_roughness.rgb, v = vec3(sqrt(1.0 - cosine * cosine), 0.0, cosine);
    float roughness = surfaces[i].f0_roughness.a, lit = 0.0;
    for (int j = 0; j < SIDE * SIDE; ++j) {
        vec2 u = (vec2(j % SIDE, j / SIDE) + 0.5) / float(SIDE);
        lit += specular_sample(u, v, f0, roughness) + diffuse * diffuse_under_lobe(f0, roughness, sqrt(u.y), cosine).r;
    }
    float lobe = specular_reflectance(f0, roughness, cosine).r;
    float mean = mean_specular_reflectance(f0, roughness).r + mean_diffuse_reflectance(vec3(diffuse), f0, roughness).r;
    found[i] = vec4(lit / float(SIDE * SIDE), diffuse * (1.0 - lobe) + lobe, mean, shown_of_lamps(v, f0, roughness));
}
