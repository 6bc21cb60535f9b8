// Mean radiance of a GGX lobe over a map of light: x y z by few filtered samples; and the total of their density over all
// directions. UNFILTERED: by many samples of the visible normals, each a look at the map as it is.
#include "common/brdf.glsl"
#include "common/lobe.glsl"
#include "common/environment.glsl"
#include "common/filtered_lobe.glsl"

layout(local_size_x = 64) in;
struct View { vec4 normal_roughness; vec4 towards; };
layout(std430) readonly buffer Views { View views[]; };
layout(std430) writeonly buffer Found { vec4 found[]; };
uniform int count, samples, directions;
uniform vec3 f0;

#ifdef UNFILTERED
vec3 mean_radiance(vec3 n, vec3 v, float roughness) {
    mat3 basis = basis_around(n);
    vec3 local = v * basis, sum = vec3(0.0), total = vec3(0.0);
    float alpha = max(roughness * roughness, 2e-3);
    int side = int(sqrt(float(samples)));
    for (int j = 0; j < side * side; ++j) {
        vec3 h = visible_normal((vec2(j % side, j / side) + 0.5) / float(side), local, alpha), l = reflect(-local, h);
        if (l.z <= 0.0) continue;
        float lambda = sqrt(alpha * alpha + (1.0 - alpha * alpha) * local.z * local.z);
        float density = 2.0 * local.z / (local.z + lambda) * ggx_distribution(h.z, alpha) / (4.0 * local.z);
        vec3 weight = specular_times_cosine(vec3(0.0, 0.0, 1.0), local, l, f0, roughness, vec2(0.0)) / density;
        sum += weight * textureLod(environment_map, vec3(octahedral_uv(basis * l), 0.0), 0.0).rgb;
        total += weight;
    }
    return sum / total;
}
#else
vec3 mean_radiance(vec3 n, vec3 v, float roughness) { return lobe_radiance(n, v, f0, roughness, 0.0, samples); }
#endif

// Integral of the density over evenly spread directions.
float whole_density(vec3 n, vec3 v, float alpha) {
    float sum = 0.0;
    for (int k = 0; k < directions; ++k) {
        float z = 1.0 - (2.0 * float(k) + 1.0) / float(directions);
        float turn = float(k) * GOLDEN_ANGLE;
        vec3 l = vec3(sqrt(1.0 - z * z) * vec2(cos(turn), sin(turn)), z), h = normalize(l + v);
        if (dot(h, n) > 0.0) sum += reflected_density(dot(h, n), dot(h, v), alpha);
    }
    return 4.0 * PI * sum / float(max(directions, 1));
}

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= uint(count)) return;
    vec3 n = views[i].normal_roughness.xyz, v = views[i].towards.xyz;
    float roughness = views[i].normal_roughness.a;
    found[i] = vec4(mean_radiance(n, v, roughness), whole_density(n, v, roughness * roughness));
}
