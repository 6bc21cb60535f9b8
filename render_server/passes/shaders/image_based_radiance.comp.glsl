// Radiance of the virtual surfaces under a map of all light around them ([D] 4.2, docs/method.md 6.6): irradiance by nine
// harmonics, what surfaces mirror by filtered importance sampling, both less what the objects hide of it themselves. With
// PRECOMPUTED that and the light from surface to surface come by the vertices' transfer (docs/method.md 6.5).
#include "common/geometry.glsl"
#include "common/brdf.glsl"
#include "common/environment.glsl"
#include "common/gathered_light.glsl"
#include "common/filtered_lobe.glsl"
#include "common/harmonics.glsl"
#include "common/interleaved.glsl"
#include "common/shown_maps.glsl"
#include "common/continuation.glsl"
#include "common/surface_change.glsl"
#ifdef MEASURED
#ifdef MATERIAL_MAPS
#include "common/texture_response.glsl"
#endif
#endif

#include "common/pixel_group.glsl"
layout(rgba16f) writeonly uniform image2D radiance_out;
uniform sampler2D virtual_raster_tint;
#pragma texels rgba8 virtual_raster_tint
#ifdef PRECOMPUTED
uniform sampler2D transferred_light;      // at the object's raster: irradiance, open fraction of what is mirrored
uniform sampler2D transferred_position;   // world m; w: 0 nothing
uniform vec4 transfer_pinhole;            // fx, fy, cx, cy of that raster
uniform bool transfer_bends;              // it is sampled through the lens model
#else
uniform sampler2D ambient_occlusion;   // open fraction of the hemisphere; the pixels of a block share its slices
#endif
uniform vec3 irradiance_coefficients[9];
uniform int sample_count;
uniform ivec4 rectangle;               // that may show an object: first pixel, size

vec3 irradiance(vec3 n) {
    float basis[HARMONICS];
    harmonics(n, basis);
    vec3 sum = vec3(0.0);
    for (int k = 0; k < 9; ++k) sum += basis[k] * irradiance_coefficients[k];
    return max(sum, vec3(0.0));
}

#ifdef PRECOMPUTED
const float SAME_SURFACE = 2.0;   // pixels off the plane

// Light of the texel that shows this place, else the mean of its neighbours that do; a surface without transfer has all light.
vec4 arriving_light(ivec2 pixel, vec4 position, vec3 normal) {
    vec2 ray = texelFetch(picture_rays, pixel, 0).xy;
    ivec2 texel = transfer_bends ? ivec2(floor(transfer_pinhole.xy * ray + transfer_pinhole.zw + 0.5)) : pixel;
    float off = SAME_SURFACE * position.w / camera_pinhole.x;
    vec4 sum = vec4(0.0);
    float found = 0.0;
    for (int i = 0; i < 9; ++i) {
        ivec2 beside = texel + ivec2((i + 4) % 9 % 3, (i + 4) % 9 / 3) - 1;   // the middle first
        beside = clamp(beside, ivec2(0), textureSize(transferred_position, 0) - 1);
        vec4 p = texelFetch(transferred_position, beside, 0);
        if (p.w == 0.0 || abs(dot(p.xyz - position.xyz, normal)) > off || distance(p.xyz, position.xyz) > 4.0 * off) continue;
        sum += texelFetch(transferred_light, beside, 0);
        found += 1.0;
        if (i == 0) break;
    }
    return found > 0.0 ? sum / found : vec4(irradiance(normal), 1.0);
}
#else
// Mean over a block of pixels that show the same surface.
float open_fraction(ivec2 pixel, vec4 position, vec3 normal) {
    float sum = 0.0, total = 0.0, pixels = 2.0 * position.w / camera_pinhole.x;
    for (int i = 0; i < INTERLEAVED * INTERLEAVED; ++i) {
        ivec2 beside = pixel + ivec2(i % INTERLEAVED, i / INTERLEAVED) - INTERLEAVED / 2;
        beside = clamp(beside, ivec2(0), textureSize(ambient_occlusion, 0) - 1);
        ivec2 raster = raster_texel(beside);
        vec4 p = texelFetch(virtual_raster_position, raster, 0);
        vec3 n = texelFetch(virtual_raster_normal, raster, 0).xyz;
        float w = p.w > 0.0 ? continuation(position.xyz, normal, p.xyz, n, pixels) + 1e-4 : 0.0;
        sum += w * texelFetch(ambient_occlusion, beside, 0).r;
        total += w;
    }
    return sum / total;
}

vec4 arriving_light(ivec2 pixel, vec4 position, vec3 normal) {
    float open = open_fraction(pixel, position, normal);
    return vec4(open * irradiance(normal), open);
}
#endif

// Half of the turn across a pixel of what the surface or (`of_coat`) its coat mirrors.
float mirrored_turn(ivec2 pixel, vec4 position, vec4 normal, bool of_coat) {
    vec3 across = change_along(pixel, ivec2(1, 0), position, normal, of_coat).normal;
    vec3 down = change_along(pixel, ivec2(0, 1), position, normal, of_coat).normal;
    return max(length(across), length(down));
}

// Mean radiance over what the surface mirrors.
vec3 mirrored_radiance(ivec2 pixel, vec4 position, vec4 normal, vec3 v, Material m) {
    vec3 n = normalize(normal.xyz);
    float footprint = mirrored_turn(pixel, position, normal, false);
#ifdef MEASURED
    if (m.measured >= 0) return measured_radiance(n, v, m.measured, footprint, sample_count);
#endif
    vec3 seen = lobe_radiance(n, v, m.f0, m.roughness, footprint, has_interface(m.f0) ? sample_count : 0);
#ifdef EXTENDED
    vec3 coat = coat_fraction(reflected_towards(m, n, v)), above = coat_normal(m.over, n);
    footprint = mirrored_turn(pixel, position, vec4(above, normal.w), true);
    seen = mix(seen, lobe_radiance(above, v, COAT_F0, m.over.roughness, footprint, m.over.coat > 0.0 ? sample_count : 0), coat);
#endif
    return seen;
}

#ifdef MEASURED
#ifdef MATERIAL_MAPS
const int LIT_FROM = 64;   // directions of equal solid angle over the hemisphere

// Nine harmonics of the radiance that arrives from there, of which irradiance_coefficients have the clamped cosine's bands.
vec3 radiance_from(vec3 direction) {
    float basis[HARMONICS];
    harmonics(direction, basis);
    vec3 sum = basis[0] * irradiance_coefficients[0] / PI;
    for (int k = 1; k < 4; ++k) sum += basis[k] * irradiance_coefficients[k] / (2.0 / 3.0 * PI);
    for (int k = 4; k < 9; ++k) sum += basis[k] * irradiance_coefficients[k] / (0.25 * PI);
    return sum;
}

// What a texture by light makes of these harmonics, as the irradiance of a white surface that would show the same.
vec3 textured_irradiance(Material m, vec3 n) {
    mat3 basis = basis_around(n);
    vec3 sum = vec3(0.0);
    for (int i = 0; i < LIT_FROM; ++i) {
        float cosine = (float(i) + 0.5) / float(LIT_FROM), level = sqrt(1.0 - cosine * cosine), turn = GOLDEN_ANGLE * float(i);
        vec3 l = basis * vec3(level * cos(turn), level * sin(turn), cosine);
        sum += base_response(m, l, cosine) * radiance_from(l);
    }
    return max(2.0 * PI * PI / float(LIT_FROM) * sum, vec3(0.0));
}
#endif
#endif

vec3 shaded(ivec2 pixel, ivec2 raster, vec4 position) {
    vec4 normal = texelFetch(virtual_raster_normal, raster, 0);
    vec3 n = normalize(normal.xyz), v = normalize(camera_position - position.xyz);
    Material m = material_at(raster, int(normal.w), texelFetch(virtual_raster_tint, raster, 0));
    vec4 light = arriving_light(pixel, position, n);
#ifdef MEASURED
#ifdef MATERIAL_MAPS
    if (is_by_light(int(normal.w))) {
        float size = position.w / camera_pinhole.x;
        take_texture(m, int(normal.w), imageLoad(virtual_raster_uv, raster).xy, n, size);
        vec3 passed = clamp(light.rgb / max(irradiance(n), vec3(1e-4)), 0.0, 2.0);   // the objects' own shadow and light
        light.rgb = passed * textured_irradiance(m, n);
        m.diffuse = vec3(1.0);
    }
#endif
#endif
    Indirect arriving = Indirect(light.rgb, light.a * mirrored_radiance(pixel, position, normal, v, m));
    return with_gathered(emitted(m, n, v), m, n, v, arriving);
}

void main() {
    ivec2 inside = ivec2(gl_GlobalInvocationID.xy), pixel = rectangle.xy + inside;
    if (any(greaterThanEqual(inside, rectangle.zw))) return;
    ivec2 raster = raster_texel(pixel);
    vec4 position = texelFetch(virtual_raster_position, raster, 0);
    if (position.w > 0.0) imageStore(radiance_out, pixel, vec4(shaded(pixel, raster, position), 1.0));
}
