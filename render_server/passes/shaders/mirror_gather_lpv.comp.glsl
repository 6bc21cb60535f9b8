// Ambient and bounced light at the reflected points that mirror_hits listed, from the light volume, and whether real
// things in the picture occlude them from the reflecting surface.
#include "common/volume.glsl"
#include "common/environment.glsl"
#include "common/lpv_light.glsl"
#include "common/lpv_exchange.glsl"
#include "common/brdf.glsl"
#include "common/materials.glsl"
#include "common/mirror.glsl"
#include "common/screen_march.glsl"
#include "common/work_list.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image2D irradiance_out;   // rgb; a: fraction not occluded by real things
layout(rgba16f) writeonly uniform image2D specular_out;     // rgb mean radiance of the specular cone
uniform isampler2D sample_pixels;
uniform sampler2D hit_position;
uniform sampler2D hit_normal;
#pragma texels rgba16i sample_pixels
#pragma texels rgba32f hit_position
#pragma texels rgba16f hit_normal

const float CLEAR = 1e-3;   // of the depth: distance of a ray's start from its own surface, and of its end from the hit

float open_fraction(Mirror m, vec3 to) {
    vec3 from = m.point + (CLEAR * m.depth + 3.0 * noise_sigma * m.depth * m.depth) * m.normal;
    ScreenHit hit = screen_hit(from, normalize(to - from), 0.0);
    return hit.fraction > 0.0 && hit.distance < distance(to, from) - CLEAR * m.depth ? 1.0 - hit.fraction : 1.0;
}

void gather(ivec2 texel) {
    vec3 position = texelFetch(hit_position, texel, 0).xyz;
    vec4 normal = texelFetch(hit_normal, texel, 0);
    Mirror m = mirror_at(mirror_pixel(texelFetch(sample_pixels, texel, 0)));
    enter_volume(position);
    vec3 q = volume_coordinate(position), d = reflect(normalize(position - m.point), normal.xyz);
    vec3 arriving = brought(q, normal.xyz).rho + from_other_volumes(position, normal.xyz);
    vec3 e = max(environment_irradiance(normal.xyz) + arriving, vec3(0.0));
    vec3 seen = environment(d, specular_half_angle(materials[int(normal.w)].dielectric.a));
    imageStore(irradiance_out, texel, vec4(e, open_fraction(m, position)));
    imageStore(specular_out, texel, vec4(seen, 1.0));
}

void main() {
    uint i = counted_group() * 64u + gl_LocalInvocationIndex;
    if (i < listed_count()) gather(texel_of_index(texels[i], textureSize(sample_pixels, 0).x));
}
