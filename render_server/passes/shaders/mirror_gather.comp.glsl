// Ambient and bounced light at the reflected points that mirror_hits listed, and how much real things occlude them
// from the reflecting surface.
#define TWO_SIDED_STARTS
#include "common/march.glsl"
#include "common/environment.glsl"
#include "common/diffuse_cones.glsl"
#include "common/brdf.glsl"
#include "common/materials.glsl"
#include "common/mirror.glsl"
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

const ConeSet WHOLE = ConeSet(1, 0, 1.0, 0.0);   // cones as wide as their fractions
const float OWN = 1.5;     // voxels from a surface that may be its own

// Unoccluded fraction of the segment between two points (voxels); both ends are left out.
float open_fraction(vec3 from, vec3 to) {
    vec3 d = normalize(to - from);
    Walk w = walk_from(from + OWN * d, d, volume_size);
    float end = length(to - from) - 2.0 * OWN, coverage = 0.0;
    for (int i = 0; i < 1024; ++i) {
        vec3 at = sample_point(w);
        if (travelled(w) > end || coverage >= WALL) break;
        if (inside_volume(at)) coverage += slice_fraction(w) * sample_near(mipmap_mu, at, w).a;
        w.plane += 1;
        w.halved = false;
    }
    return 1.0 - blocked_fraction(coverage);
}

void gather(ivec2 texel) {
    vec3 position = texelFetch(hit_position, texel, 0).xyz;
    vec4 normal = texelFetch(hit_normal, texel, 0);
    Mirror m = mirror_at(mirror_pixel(texelFetch(sample_pixels, texel, 0)));
    enter_volume(position);
    vec3 q = volume_coordinate(position);
    start_on(normal.xyz, is_two_sided(int(normal.w)));
    vec3 d = reflect(normalize(position - m.point), normal.xyz);
    Lobe lobe = lobe_along(d, specular_half_angle(materials[int(normal.w)].dielectric.a), vec3(1.0));
    Gathered found = gather_cones(q, normal.xyz, WHOLE, true, 0, 1, lobe, lobe);
    imageStore(irradiance_out, texel, vec4(found.e_rho, open_fraction(volume_coordinate(m.point) + OWN * m.normal, q)));
    imageStore(specular_out, texel, vec4(found.lobe_rho, 1.0));
}

void main() {
    uint i = counted_group() * 64u + gl_LocalInvocationIndex;
    if (i < listed_count()) gather(texel_of_index(texels[i], textureSize(sample_pixels, 0).x));
}
