// The virtual objects in the mirror image of smooth surfaces: rays over each pixel and its lobe. One invocation
// per ray; a pixel's rays are adjacent in a workgroup and summed there.
#pragma switch TRANSMISSION
#define OPAQUE_SHADOWS   // that buffer would be one too many
#include "common/lights.glsl"
#include "common/brdf.glsl"
#include "common/environment.glsl"
#include "common/object_light.glsl"
#include "common/mirror_rays.glsl"
#include "common/upsample.glsl"
#include "common/rolled.glsl"
#include "common/work_list.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image2D traced;   // rgb radiance of objects times fraction; a: fraction of the lobe
layout(r16f) writeonly uniform image2D hit_distance;         // mean m from the surface to the objects, 0 none
uniform sampler2D hit_position;
uniform sampler2D hit_normal;
uniform sampler2D hit_irradiance;
uniform sampler2D hit_specular;
#pragma texels rgba32f hit_position
#pragma texels rgba16f hit_normal hit_irradiance hit_specular

shared vec4 of_ray[64];
shared float counted[64];    // 1: the ray leaves the surface
shared float distances[64];  // to an object, 0: none

// Ambient and bounced light, as gathered near this point's mirror image; `open`: fraction not occluded by real
// things.
Indirect gathered(ivec2 pixel, MeshSurface s, float seen_at, out float open) {
    Indirect sum = Indirect(vec3(0.0), vec3(0.0));
    float total = 0.0;
    open = 0.0;
    for (int j = 0; j < rolled(4); ++j) {
        float w;
        ivec2 texel = low_texel(pixel, j, w);
        vec4 position = texelFetch(hit_position, texel, 0);
        if (position.w == 0.0) continue;
        vec3 normal = texelFetch(hit_normal, texel, 0).xyz;
        w *= continuation(s.position, s.normal, position.xyz, normal, sample_distance * seen_at) + 1e-4;
        vec4 e = texelFetch(hit_irradiance, texel, 0);
        sum.irradiance += w * e.rgb;
        sum.specular += w * texelFetch(hit_specular, texel, 0).rgb;
        open += w * e.a;
        total += w;
    }
    if (total == 0.0) {   // too small for the reduced grid: ambient light, unshadowed
        open = 1.0;
        return Indirect(environment_irradiance(s.normal), vec3(0.0));
    }
    open /= total;
    return Indirect(sum.irradiance / total, sum.specular / total);
}

// rgb radiance, a: 1 if the ray hits an object, less if real things are in front of it.
vec4 trace(ivec2 pixel, Ray ray, out float met_at) {
    MeshHit hit = closest_hit(ray);
    met_at = 0.0;
    if (hit.triangle < 0) return vec4(0.0);
    met_at = hit.distance;
    MeshSurface s = surface_of(hit, ray);
    float open;
    Indirect indirect = gathered(pixel, s, distance(camera_position, ray.from) + hit.distance, open);
    Material material = material_of(s.material, s.uv, s.tint, 0.0);
    vec3 radiance = object_radiance(s.position, distance(camera_position, s.position), s.normal, -ray.direction, material, indirect, 0.0);
#ifdef TRANSMISSION
    // What is behind goes on below the object, unrefracted.
    vec3 passing = material.passing * (1.0 - specular_reflectance(material.f0, material.roughness, -dot(s.normal, ray.direction)));
#ifdef EXTENDED
    passing *= reflected_towards(material, s.normal, -ray.direction).below;
#endif
    return open * vec4(radiance, 1.0 - dot(passing, vec3(1.0 / 3.0)));
#else
    return open * vec4(radiance, 1.0);
#endif
}

void main() {
    uint inside = gl_LocalInvocationIndex;
    uint i = counted_group() * (64u / uint(RAY_COUNT)) + inside / uint(RAY_COUNT);
    int j = int(inside % uint(RAY_COUNT));
    of_ray[inside] = vec4(0.0);
    counted[inside] = distances[inside] = 0.0;
    ivec2 pixel = ivec2(-1);
    if (i < listed_count()) {
        pixel = texel_of_index(texels[i], imageSize(traced).x);
        Mirror m = mirror_at(pixel);
        Ray ray = lobe_ray(pixel, m, ray_numbers(pixel, j), 1.0);
        if (dot(ray.direction, m.normal) > 0.0) {
            counted[inside] = 1.0;
            of_ray[inside] = trace(pixel, ray, distances[inside]);
        }
    }
    memoryBarrierShared();
    barrier();
    if (j != 0 || pixel.x < 0) return;
    vec4 sum = vec4(0.0);
    float count = 0.0, met = 0.0, total = 0.0;
    for (int k = 0; k < rolled(RAY_COUNT); ++k) {
        sum += of_ray[inside + uint(k)];
        count += counted[inside + uint(k)];
        total += distances[inside + uint(k)];
        met += float(distances[inside + uint(k)] > 0.0);
    }
    imageStore(traced, pixel, sum / max(count, 1.0));
    imageStore(hit_distance, pixel, vec4(total / max(met, 1.0)));
}
