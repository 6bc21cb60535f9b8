// Where each beam may light the picture; and a ball around the surfaces that need light in each tile (its middle and radius, world m),
// of real surfaces and below them of objects. The first workgroups find the balls, the others walk the beams. With REUSES, some
// between them bring over the caustics that the last frame's texels know: one dispatch, for none of these waits for another.
// CLEARS: the threads that walk the beams also empty the sums. ENDS: they walk those that were sent, and end them first.
#include "common/geometry.glsl"
#include "common/walk.glsl"
#define FINDS_PLACES
#if defined(REUSES) || defined(CLEARS)
#define ADDS_CAUSTICS
#endif
#ifdef ENDS
#define APPENDS_BEAMS
#endif
#include "common/beam_footprint.glsl"
#include "common/beam_tiles.glsl"
#include "common/camera.glsl"
#ifdef ENDS
#include "common/beam_ends.glsl"
#endif

layout(local_size_x = 64) in;
layout(rgba32f) writeonly uniform image2D tile_balls;
uniform ivec2 picture_pixels;
#ifdef REUSES
#include "common/reprojection.glsl"
#include "common/last_texels.glsl"
layout(std430) readonly buffer LastSums { int last_sums[]; };
#else
uniform int scale;
#endif

const float LEAST_SLANT = 1.5;     // around corners too
// Footprints with a radius of this many texels of the reduced grid go there: a standard deviation is then a texel, and the grid holds
// a normal distribution.
const float SMOOTH_TEXELS = FOOTPRINT_CUT;

// Slant of the surface that the beam hits: length of the footprint relative to the beam's width.
float slant_at(Beam beam, int layer, vec2 centre) {
    vec3 normal;
    position_on(layer, clamp(ivec2(round(centre)), ivec2(0), picture_pixels - 1), normal);
    return clamp(-1.0 / min(dot(normal, beam.direction.xyz), -1e-3), LEAST_SLANT, LONGEST);
}

BeamPlace place_of(Beam beam) {
    vec3 c = (camera_from_world * vec4(beam.from.xyz + beam.from.w * beam.direction.xyz, 1.0)).xyz;
    if (c.z <= 0.0) return BeamPlace(ivec2(0), ivec2(-1), -1, 0);
    int layer = beam.flux.w > 0.5 ? OBJECT_LAYER : REAL_LAYER;
    vec2 centre = camera_pinhole.xy * c.xy / c.z + camera_pinhole.zw;
    float radius = camera_pinhole.x * beam.direction.w / c.z;
    bool sharp = radius <= SMOOTH_TEXELS * float(scale);
    int unit = sharp ? 1 : scale;
    ivec2 last = (picture_pixels + unit - 1) / unit - 1;
    float extent = slant_at(beam, layer, centre) * radius;
    ivec2 low = max(ivec2(floor((centre - extent) / float(unit))), ivec2(0));
    ivec2 high = min(ivec2(ceil((centre + extent) / float(unit))), last);
    if (any(greaterThan(low, high))) return BeamPlace(ivec2(0), ivec2(-1), -1, 0);   // nowhere
    return BeamPlace(low, high, layer, sharp ? 1 : 0);
}

vec4 ball_around(ivec2 tile, int layer) {
    vec3 low = vec3(1e9), high = vec3(-1e9);
    for (int i = 0; i < TILE * TILE; ++i) {
        LitTexel t = lit_texel(TILE * tile + ivec2(i % TILE, i / TILE), layer);
        low = min(low, t.needed ? t.p : low);
        high = max(high, t.needed ? t.p : high);
    }
    bool any_needed = low.x <= high.x;
    return any_needed ? vec4(0.5 * (low + high), 0.5 * distance(low, high)) : vec4(0.0, 0.0, 0.0, -1e9);
}

void find_ball(int number) {
    if (number >= 2 * tiles.x * tiles.y) return;
    ivec2 at = ivec2(number % tiles.x, number / tiles.x);
    bool is_real = at.y < tiles.y;
    imageStore(tile_balls, at, ball_around(at - ivec2(0, is_real ? 0 : tiles.y), is_real ? REAL_LAYER : OBJECT_LAYER));
}

#ifdef REUSES
int sums_at(ivec2 texel) { return sums_of_texel(texel, textureSize(sample_pixels, 0), picture_pixels); }

void reuse(ivec2 texel, int layer, vec4 position, vec3 normal) {
    LastTexels last = last_texels(position, normal, layer != 0);
    vec3 sum = vec3(0.0);
    for (int j = 0; j < 4; ++j) {
        if (last.weights[j] == 0.0) continue;
        int at = sums_at(last.base + ivec2(j & 1, j >> 1)) + layer;
        sum += last.weights[j] * vec3(last_sums[at], last_sums[at + 1], last_sums[at + 2]);
    }
    int to = sums_at(texel) + layer;
    for (int i = 0; i < 3; ++i) caustic_sums[to + i] = int(round(sum[i]));
}

// Of the texels' layers that need no light of this frame.
void reuse_texel(int number) {
    ivec2 size = textureSize(sample_pixels, 0), texel = ivec2(number % size.x, number / size.x);
    if (!has_history || texel.y >= size.y) return;
    ivec4 pixels = lit_pixels(texelFetch(sample_pixels, texel, 0));
    uint stale = texelFetch(stale_texels, texel, 0).r;
    if (pixels.x >= 0 && (stale & STALE_REAL) == 0u)
        reuse(texel, REAL_LAYER, texelFetch(real_surface_position, pixels.xy, 0), texelFetch(real_surface_normal, pixels.xy, 0).xyz);
    ivec2 raster = raster_texel(max(pixels.zw, ivec2(0)));
    if (pixels.z >= 0 && (stale & STALE_OBJECT) == 0u)
        reuse(texel, OBJECT_LAYER, texelFetch(virtual_raster_position, raster, 0), texelFetch(virtual_raster_normal, raster, 0).xyz);
}

int texels_reused() { return textureSize(sample_pixels, 0).x * textureSize(sample_pixels, 0).y; }
#else
void reuse_texel(int number) {}

int texels_reused() { return 0; }
#endif

#ifdef ENDS
uint beams_walked() { return beams_sent(); }

void find_place(uint i) {
    Beam beam;
    if (ends(sent_beams[i], beam)) put_place(append_beam(beam), place_of(beam));
}
#else
uint beams_walked() { return beams_held(); }

void find_place(uint i) { put_place(i, place_of(beam_at(i))); }
#endif

uint groups_of(int items) { return uint(items + 63) / 64u; }

void main() {
    uint groups = gl_NumWorkGroups.x, group = spread(gl_WorkGroupID.x, groups), thread = gl_LocalInvocationID.x;
    uint of_balls = groups_of(2 * tiles.x * tiles.y), before_beams = of_balls + groups_of(texels_reused());
    if (group < of_balls) {
        find_ball(int(64u * group + thread));
    } else if (group < before_beams) {
        reuse_texel(int(64u * (group - of_balls) + thread));
    } else {
        uint count = beams_walked();
        for (uint i = 64u * (group - before_beams) + thread; i < count; i += 64u * (groups - before_beams)) find_place(i);
#ifdef CLEARS
        uint sums = uint(caustic_sums.length());
        for (uint i = 64u * (group - before_beams) + thread; i < sums; i += 64u * (groups - before_beams)) caustic_sums[i] = 0;
#endif
    }
}
