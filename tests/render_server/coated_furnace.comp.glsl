// What coated surfaces reflect of radiance 1 from everywhere: x by the lights' formulas, integrated over all directions, y by those for
// gathered light, z by what voxels and cells reflect of it.
#include "common/brdf.glsl"
#include "common/lobe.glsl"
#include "common/gathered_light.glsl"

layout(local_size_x = 64) in;
struct Surface { vec4 diffuse_cosine; vec4 f0_roughness; vec4 coat; vec4 sheen; };
layout(std430) readonly buffer Surfaces { Surface surfaces[]; };
layout(std430) writeonly buffer Found { vec4 found[]; };
uniform int count;

const int SIDE = 64;   // samples of each of the lobes, and of the hemisphere twice, each SIDE^2
const vec3 UP = vec3(0.0, 0.0, 1.0);

float lobe_density(vec3 v, vec3 l, float roughness) {
    float alpha = max(roughness * roughness, 2e-3), h = normalize(v + l).z;
    float masked = 2.0 * v.z / (v.z + sqrt(alpha * alpha + (1.0 - alpha * alpha) * v.z * v.z));
    return masked * ggx_distribution(h, alpha) / (4.0 * v.z);
}

vec3 lobe_sample(vec2 u, vec3 v, float roughness) {
    return reflect(-v, visible_normal(u, v, max(roughness * roughness, 2e-3)));
}

vec3 upwards(float z, float turn) { return vec3(sqrt(max(1.0 - z * z, 0.0)) * vec2(cos(turn), sin(turn)), z); }

// Light of one direction, over the mean density of all four kinds of samples (Veach and Guibas 1995); the last is dense at the horizon.
float reflected(Material m, vec3 v, vec3 l) {
    if (l.z <= 0.0) return 0.0;
    float density = lobe_density(v, l, m.roughness) + lobe_density(v, l, m.over.roughness) + l.z / PI + 0.25 / (PI * sqrt(l.z));
    return coated_response(m, UP, v, l, l.z, vec2(0.0)).r / density;
}

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= uint(count)) return;
    Surface s = surfaces[i];
    float cosine = s.diffuse_cosine.a, lit = 0.0;
    Material m;
    m.diffuse = s.diffuse_cosine.rgb;
    m.f0 = s.f0_roughness.rgb;
    m.roughness = s.f0_roughness.a;
    m.emission = vec3(0.0);
    m.over = Coating(s.coat.x, s.coat.y, vec3(0.0), s.sheen.rgb, s.sheen.a);
    vec3 v = upwards(cosine, 0.0);
    for (int j = 0; j < SIDE * SIDE; ++j) {
        vec2 u = (vec2(j % SIDE, j / SIDE) + 0.5) / float(SIDE);
        lit += reflected(m, v, lobe_sample(u, v, m.roughness)) + reflected(m, v, lobe_sample(u, v, m.over.roughness))
            + reflected(m, v, upwards(sqrt(u.y), 2.0 * PI * u.x)) + reflected(m, v, upwards(u.y * u.y, 2.0 * PI * u.x));
    }
    vec3 gathered = with_gathered(vec3(0.0), m, UP, v, Indirect(vec3(PI), vec3(1.0)));
    vec3 base = mean_diffuse_reflectance(m.diffuse, m.f0, m.roughness) + mean_specular_reflectance(m.f0, m.roughness);
    found[i] = vec4(lit / float(SIDE * SIDE), gathered.r, mean_coated_reflectance(m, base).r, 0.0);
}
