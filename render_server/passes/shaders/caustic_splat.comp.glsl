// Adds each beam's irradiance to the pixels around its hit; a workgroup per beam. Sums are integers, so that their
// order does not matter.
#include "common/geometry.glsl"
#include "common/basis.glsl"
#include "common/beams.glsl"
#define ADDS_CAUSTICS
#include "common/caustic_sums.glsl"

#include "common/caustic_tiles.glsl"

layout(local_size_x = 64) in;
uniform isampler2D sample_pixels;
uniform usampler2D tiles;   // of texels of the reduced grid
uniform int scale;
#include "common/camera.glsl"
uniform ivec2 picture_pixels;
#ifdef REUSES
uniform usampler2D stale_texels;   // 0: light there is the last frame's
#endif

const float LEAST_SLANT = 1.5;   // around corners too
const float SMOOTH_TEXELS = 1.0;   // footprints with a radius of this many texels of the reduced grid go there
const float LONGEST = 4.0;   // limit of a slanted footprint, in radii of the beam

vec3 position_on(int layer, ivec2 pixel, out vec3 normal) {
    ivec2 raster = raster_texel(pixel);
    vec4 real = texelFetch(real_surface_position, pixel, 0), object = texelFetch(virtual_raster_position, raster, 0);
    normal = layer == REAL_LAYER ? texelFetch(real_surface_normal, pixel, 0).xyz : texelFetch(virtual_raster_normal, raster, 0).xyz;
    return (layer == REAL_LAYER ? real.w > 0.0 : object.w > 0.0) ? (layer == REAL_LAYER ? real.xyz : object.xyz) : vec3(1e9);
}

// Whether light on a real surface is computed at this texel of the reduced grid.
bool is_wanted(int layer, ivec2 texel) {
#ifdef REUSES
    return (texelFetch(stale_texels, texel, 0).r & (layer == REAL_LAYER ? 3u : 4u)) != 0u;
#else
    return true;
#endif
}

// `at`: index of the pixel's sums.
void add(Beam beam, mat3 basis, int layer, ivec2 pixel, int at) {
    vec3 normal;
    vec3 away = (position_on(layer, pixel, normal) - beam.from.xyz) * basis;
    if (abs(away.z - beam.from.w) > LONGEST * beam.direction.w || away.z <= 0.0) return;
    float cosine = -dot(normal, beam.direction.xyz);
    float x2 = beam.across.x * away.x * away.x + 2.0 * beam.across.y * away.x * away.y + beam.across.z * away.y * away.y;
    if (cosine <= 0.0 || x2 > FOOTPRINT_CUT * FOOTPRINT_CUT) return;
    vec3 irradiance = beam.flux.rgb * (cosine * beam.across.w * exp(-0.5 * x2));
    for (int j = 0; j < 3; ++j) {
        int part = int(round(irradiance[j] * CAUSTIC_STEPS));
        if (part != 0) atomicAdd(caustic_sums[at + layer + j], part);
    }
}

// Slant of the surface that the beam hits: length of the footprint relative to the beam's width.
float slant_at(Beam beam, int layer, vec2 centre) {
    vec3 normal;
    position_on(layer, clamp(ivec2(round(centre)), ivec2(0), picture_pixels - 1), normal);
    return clamp(-1.0 / min(dot(normal, beam.direction.xyz), -1e-3), LEAST_SLANT, LONGEST);
}

void splat(Beam beam) {
    vec3 c = (camera_from_world * vec4(beam.from.xyz + beam.from.w * beam.direction.xyz, 1.0)).xyz;
    if (c.z <= 0.0) return;
    int layer = beam.flux.w > 0.5 ? OBJECT_LAYER : REAL_LAYER;
    vec2 centre = camera_pinhole.xy * c.xy / c.z + camera_pinhole.zw;
    float radius = camera_pinhole.x * beam.direction.w / c.z;
    bool smooth_one = radius > SMOOTH_TEXELS * float(scale);
    int unit = smooth_one ? scale : 1;
    ivec2 grid = textureSize(sample_pixels, 0), last = (smooth_one ? grid : picture_pixels) - 1;
    float extent = slant_at(beam, layer, centre) * radius;
    ivec2 low = max(ivec2(floor((centre - extent) / float(unit))), ivec2(0));
    ivec2 high = min(ivec2(ceil((centre + extent) / float(unit))), last);
    if (any(greaterThan(low, high))) return;
    mat3 basis = basis_around(beam.direction.xyz);
    ivec2 first = low / 8, count = high / 8 - first + 1;
    for (int i = 0; i < count.x * count.y; ++i) {
        ivec2 tile = first + ivec2(i % count.x, i / count.x);
        if (smooth_one && (texelFetch(tiles, tile, 0).r & (layer == REAL_LAYER ? REAL_TILE : OBJECT_TILE)) == 0u) continue;
        ivec2 place = place_in_tile(tile);
        if (any(lessThan(place, low)) || any(greaterThan(place, high))) continue;
        if ((smooth_one || layer == REAL_LAYER) && !is_wanted(layer, smooth_one ? place : place / scale)) continue;
        ivec4 pixels = smooth_one ? texelFetch(sample_pixels, place, 0) : place.xyxy;
        ivec2 pixel = layer == REAL_LAYER ? pixels.xy : pixels.zw;
        int at = smooth_one ? sums_of_texel(place, grid, picture_pixels) : sums_of_pixel(place, picture_pixels);
        if (pixel.x >= 0) add(beam, basis, layer, pixel, at);
    }
}

void main() {
    uint count = min(beam_count, uint(beams.length()));
    for (uint i = gl_WorkGroupID.x; i < count; i += gl_NumWorkGroups.x) splat(beams[i]);
}
