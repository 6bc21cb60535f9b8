// Radiance of the virtual surfaces (docs/method.md 4.7): direct light shadowed by real and virtual geometry, GGX lobes,
// diffuse cones and the specular cone of the rho set.
#include "common/lit_pixels.glsl"
#include "common/lights.glsl"
#include "common/brdf.glsl"
#include "common/geometry.glsl"
#include "common/object_light.glsl"
#include "common/shown_maps.glsl"
#include "common/shown_pixels.glsl"
#include "common/walk.glsl"
#include "common/caustics.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image2D radiance_out;
uniform sampler2D object_coverage;
uniform sampler2D cone_irradiance;
uniform sampler2D cone_specular;
uniform sampler2D virtual_raster_tint;
uniform sampler2D screen_reflection;   // rgb radiance times fraction; a: fraction of the specular lobe
#pragma texels rgba16f cone_irradiance cone_specular screen_reflection
#pragma texels rgba8 virtual_raster_tint
#pragma texels r16f object_coverage
uniform bool has_screen_reflection;
#include "common/camera.glsl"

Indirect indirect_at(ivec2 pixel, vec4 position, vec3 normal) {
    Indirect sum = Indirect(vec3(0.0), vec3(0.0));
    float total = 0.0;
    for (int j = 0; j < 4; ++j) {
        float w;
        ivec2 texel = low_texel(pixel, j, w);
        vec4 e = texelFetch(cone_irradiance, texel, 0);
        if (e.a == 0.0) continue;
        ivec2 raster = raster_texel(texelFetch(sample_pixels, texel, 0).zw);
        vec3 sp = texelFetch(virtual_raster_position, raster, 0).xyz;
        vec3 sn = texelFetch(virtual_raster_normal, raster, 0).xyz;
        w *= continuation(position.xyz, normal, sp, sn, sample_distance * position.w) + 1e-4;
        sum.irradiance += w * e.rgb;
        sum.specular += w * texelFetch(cone_specular, texel, 0).rgb;
        total += w;
    }
    if (total > 0.0) { sum.irradiance /= total; sum.specular /= total; }
    return sum;
}

const float STRAIGHT = 0.25;   // sine of the greatest angle between a chord of a smooth surface and its mean tangent plane

// Squared change of the normal from a pixel to the next along an axis: the mean of both sides, of which edges do not count. (The chord
// of an arc is at right angles to the mean of the normals at its ends.)
float turn_along(ivec2 pixel, ivec2 axis, vec4 position, vec4 normal) {
    float sum = 0.0;
    for (int side = -1; side <= 1; side += 2) {
        ivec2 raster = raster_texel(clamp(pixel + side * axis, ivec2(0), textureSize(object_coverage, 0) - 1));
        vec4 p = texelFetch(virtual_raster_position, raster, 0), n = texelFetch(virtual_raster_normal, raster, 0);
        vec3 chord = (p - position).xyz, turn = (n - normal).xyz, both = (n + normal).xyz;
        bool goes_on = p.w > 0.0 && n.w == normal.w && abs(dot(chord, both)) <= STRAIGHT * length(chord) * length(both);
        sum += goes_on ? 0.5 * dot(turn, turn) : 0.0;
    }
    return sum;
}

// Half-angle (rad) of a disc over which a curved surface turns the normal within a pixel: along an axis, its mean square is a quarter of
// the half-angle's, and that of a square pixel a twelfth of the squared change.
float turn_within(ivec2 pixel, vec4 position, vec4 normal) {
    float x = turn_along(pixel, ivec2(1, 0), position, normal), y = turn_along(pixel, ivec2(0, 1), position, normal);
    return sqrt((x + y) / 6.0);
}

void shade(ivec2 pixel) {
    ivec2 raster = raster_texel(pixel);
    vec4 position = texelFetch(virtual_raster_position, raster, 0);
    vec4 normal = texelFetch(virtual_raster_normal, raster, 0);
    Material m = material_at(raster, int(normal.w), texelFetch(virtual_raster_tint, raster, 0));
#ifdef MEASURED
#ifdef MATERIAL_MAPS
    float size = position.w / camera_pinhole.x;
    if (is_by_light(int(normal.w)))
        take_texture(m, int(normal.w), imageLoad(virtual_raster_uv, raster).xy, normal.xyz, size);
#endif
#endif
    vec3 v = normalize(camera_position - position.xyz);
    Indirect indirect = indirect_at(pixel, position, normal.xyz);
    if (has_screen_reflection) {
        vec4 seen = texelFetch(screen_reflection, pixel, 0);
        indirect.specular = seen.rgb + (1.0 - seen.a) * indirect.specular;
    }
    indirect.irradiance += caustic_irradiance(pixel, textureSize(object_coverage, 0), OBJECT_LAYER, position.xyz, normal.xyz, position.w);
    vec3 radiance = object_radiance(position.xyz, position.w, normal.xyz, v, m, indirect, turn_within(pixel, position, normal));
    imageStore(radiance_out, pixel, vec4(radiance, 1.0));
}

void main() {
    uint i = first_item();
    if (i < pixels_shown()) do shade(shown_pixel(i)); while ((i += items_apart()) < pixels_shown());
}
