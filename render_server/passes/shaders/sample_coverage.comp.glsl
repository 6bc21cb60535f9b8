// One sample of a pixel from a raster of the objects whose texel centres are shifted by `offset`: the fraction of the pixel that they
// cover, and the surface that represents them, that of the sample nearest to the pixel's centre. FIRST: the first sample of every
// pixel, and which pixels may differ in the others: these are listed, and the tiles of the raster that they lie in marked. Otherwise:
// a further sample of those.
#include "common/in_front.glsl"
#ifdef FIRST
#define APPENDS_TEXELS
#endif
#include "common/work_list.glsl"

layout(rgba32f) uniform image2D position_out;
layout(rgba16f) uniform image2D normal_out;
layout(rg32f) writeonly uniform image2D uv_out;
layout(rgba8) writeonly uniform image2D tint_out;
// r: fraction in front of the real surface, g: behind it, b: g times its mean depth
layout(rgba16f) uniform image2D sample_coverage;
uniform sampler2D virtual_raster_uv;
uniform sampler2D virtual_raster_tint;
// samples of another surface: the first one's position, w: their fraction
layout(rgba32f) uniform image2D second_surface;
#include "common/camera.glsl"
uniform vec2 offset;           // pixels
uniform float weight;          // of a sample
uniform ivec4 rectangle;       // first pixel and size of the part of the picture that may show an object
uniform ivec4 raster_rectangle;  // the same of the raster: nothing was drawn beyond it

// In texels, whose centres are at integers.
vec2 place_in_raster(ivec2 pixel) {
    return lens_distortion ? raster_pinhole.xy * texelFetch(picture_rays, pixel, 0).xy + raster_pinhole.zw : vec2(pixel);
}

// Exactly one texel centre of the shifted raster is within half a pixel of any position.
ivec2 sampled_texel(ivec2 pixel) { return ivec2(floor(place_in_raster(pixel) - offset + 0.5)); }

vec4 position_at(ivec2 raster) {
    ivec2 inside = raster - raster_rectangle.xy;
    bool drawn = all(greaterThanEqual(inside, ivec2(0))) && all(lessThan(inside, raster_rectangle.zw));
    return drawn ? texelFetch(virtual_raster_position, raster, 0) : vec4(0.0);
}

vec3 normal_at(ivec2 raster) { return texelFetch(virtual_raster_normal, raster, 0).xyz; }

void copy_surface(ivec2 pixel, ivec2 raster, vec4 position) {
    imageStore(position_out, pixel, position);
    imageStore(normal_out, pixel, texelFetch(virtual_raster_normal, raster, 0));
    imageStore(uv_out, pixel, texelFetch(virtual_raster_uv, raster, 0));
    imageStore(tint_out, pixel, texelFetch(virtual_raster_tint, raster, 0));
}

// Whether a point is off the plane (p, n) by more than a pixel spans there, or faces another way (37 degrees; a smooth surface bends
// less within a pixel).
bool is_another(vec3 p, vec3 n, vec4 position, vec3 normal) {
    return abs(dot(position.xyz - p, n)) > position.w / camera_pinhole.x || dot(normal, n) < 0.8;
}

vec4 covered(bool seen, float depth) { return seen ? vec4(1.0, 0.0, 0.0, 0.0) : vec4(0.0, 1.0, depth, 0.0); }

#ifdef FIRST
#include "common/raster_tiles.glsl"
#pragma switch CUTOUTS
layout(local_size_x = 8, local_size_y = 8) in;
layout(std430) buffer Tiles { uint tiles[]; };

const ivec2 NEIGHBOURS[8] = ivec2[](ivec2(-1), ivec2(0, -1), ivec2(1, -1), ivec2(-1, 0), ivec2(1, 0), ivec2(-1, 1), ivec2(0, 1), ivec2(1));

// Whether a neighbour's first sample shows what this one's shows: nothing, or the same surface, on the same side of the real one.
bool shows_the_same(ivec2 beside, float real, vec4 position, vec3 normal) {
    if (any(lessThan(beside, ivec2(0))) || any(greaterThanEqual(beside, ivec2(picture_size)))) return false;
    ivec2 raster = sampled_texel(beside);
    vec4 other = position_at(raster);
    if (position.w <= 0.0 || other.w <= 0.0) return position.w <= 0.0 && other.w <= 0.0;
    return is_hidden(real, other.w) == is_hidden(real, position.w) && !is_another(position.xyz, normal, other, normal_at(raster));
}

// Whether all samples show what the first one shows. They do if the eight neighbours' do: of two sides of a straight edge within a
// pixel, each has the first sample of the pixel or of a neighbour, unless it is thin. Of what is cut out or blended, nothing is known
// before it is drawn.
bool is_even(ivec2 pixel, vec4 position, vec3 normal) {
#ifdef CUTOUTS
    return false;
#else
    float real = texelFetch(real_surface_position, pixel, 0).w;
    bool even = true;
    for (int i = 0; i < 8; ++i) even = shows_the_same(pixel + NEIGHBOURS[i], real, position, normal) && even;
    return even;
#endif
}

// The tiles of a pixel's samples.
int tile_around(ivec2 pixel, int i) {
    return tile_number(tile_of(place_in_raster(pixel) + REACH * (2.0 * vec2(i & 1, i >> 1) - 1.0)));
}

bool may_be_thin(ivec2 pixel) {
    uint marks = 0u;
    for (int i = 0; i < 4; ++i) marks |= tiles[tile_around(pixel, i)];
    return (marks & THIN) != 0u;
}

void main() {
    ivec2 inside = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(inside, rectangle.zw))) return;
    ivec2 pixel = rectangle.xy + inside, raster = sampled_texel(pixel);
    vec4 position = position_at(raster);
    bool is_covered = position.w > 0.0, even = !may_be_thin(pixel) && is_even(pixel, position, normal_at(raster));
    if (is_covered) {
        copy_surface(pixel, raster, position);
        imageStore(sample_coverage, pixel, (even ? 1.0 : weight) * covered(in_front(pixel, position.w) > 0.0, position.w));
    }
    if (even) return;
    append_texel(pixel, int(picture_size.x));
    for (int i = 0; i < 4; ++i) atomicOr(tiles[tile_around(pixel, i)], UNEVEN);
}
#else
layout(local_size_x = 64) in;

void add_to_second(ivec2 pixel, vec4 position, vec3 normal) {
    if (!is_another(imageLoad(position_out, pixel).xyz, imageLoad(normal_out, pixel).xyz, position, normal)) return;
    vec4 before = imageLoad(second_surface, pixel);
    imageStore(second_surface, pixel, vec4(before.w > 0.0 ? before.xyz : position.xyz, before.w + weight));
}

void add_sample(ivec2 pixel) {
    ivec2 raster = sampled_texel(pixel);
    vec4 position = position_at(raster);
    if (position.w <= 0.0) return;
    vec4 sum = imageLoad(sample_coverage, pixel);
    bool seen = in_front(pixel, position.w) > 0.0;
    // samples come in the order of their distance from the centre; a visible one takes precedence over a hidden one
    if (sum.r == 0.0 && (seen || sum.g == 0.0)) copy_surface(pixel, raster, position);
    if (sum.r > 0.0 && seen) add_to_second(pixel, position, normal_at(raster));
    imageStore(sample_coverage, pixel, sum + weight * covered(seen, position.w));
}

void main() {
    uint count = listed_count();
    for (uint i = first_item(); i < count; i += items_apart()) add_sample(texel_of_index(texels[i], int(picture_size.x)));
}
#endif
