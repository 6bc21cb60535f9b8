// The first sample of each pixel, at its centre, from the raster of the objects: the fraction of the pixel that they cover, and the
// surface that represents them. Pixels whose other samples may differ are listed for edge_samples.comp.glsl, and the tiles of the
// raster that they lie in marked.
#include "common/samples.glsl"
#define APPENDS_TEXELS
#include "common/work_list.glsl"
#include "common/raster_tiles.glsl"
#pragma switch CUTOUTS
#pragma switch PACKS_EXTENDED

#include "common/pixel_group.glsl"
layout(rgba32f) writeonly uniform image2D position_out;
layout(rgba16f) writeonly uniform image2D normal_out;
layout(rg32f) writeonly uniform image2D uv_out;
layout(rgba8) writeonly uniform image2D tint_out;
// r: fraction in front of the real surface, g: behind it, b: g times its mean depth
layout(rgba16f) writeonly uniform image2D sample_coverage;
layout(rgba32f) writeonly uniform image2D second_surface;   // as in edge_samples.comp.glsl
#pragma outputs position_out normal_out uv_out tint_out sample_coverage second_surface
layout(std430) buffer Tiles { Tile tiles[]; };
uniform sampler2D virtual_raster_uv;
uniform sampler2D virtual_raster_tint;
#pragma texels rg32f virtual_raster_uv
#pragma texels rgba8 virtual_raster_tint
#ifdef PACKS_EXTENDED
layout(rgba32ui) writeonly uniform uimage2D extended_out;
#pragma outputs extended_out
uniform usampler2D virtual_raster_extended;
#pragma texels rgba32ui virtual_raster_extended
#endif
uniform float weight;          // of a sample
uniform ivec4 rectangle;       // first pixel and size of the part of the picture that may show an object, or did before
uniform ivec4 raster_rectangle;  // the same of the raster: nothing was drawn beyond it

// Exactly one texel centre is within half a pixel of any position.
ivec2 sampled_texel(ivec2 pixel) { return ivec2(floor(place_in_raster(pixel) + 0.5)); }

vec4 position_at(ivec2 raster) {
    ivec2 inside = raster - raster_rectangle.xy;
    bool drawn = all(greaterThanEqual(inside, ivec2(0))) && all(lessThan(inside, raster_rectangle.zw));
    return drawn ? texelFetch(virtual_raster_position, raster, 0) : vec4(0.0);
}

vec3 normal_at(ivec2 raster) { return texelFetch(virtual_raster_normal, raster, 0).xyz; }

void copy_surface(ivec2 pixel, ivec2 raster, vec4 position) {
    bool drawn = position.w > 0.0;
    imageStore(position_out, pixel, position);
    imageStore(normal_out, pixel, drawn ? texelFetch(virtual_raster_normal, raster, 0) : vec4(0.0));
    imageStore(uv_out, pixel, drawn ? texelFetch(virtual_raster_uv, raster, 0) : vec4(0.0));
    imageStore(tint_out, pixel, drawn ? texelFetch(virtual_raster_tint, raster, 0) : vec4(0.0));
#ifdef PACKS_EXTENDED
    imageStore(extended_out, pixel, drawn ? texelFetch(virtual_raster_extended, raster, 0) : uvec4(0u));
#endif
}

const uint NEIGHBOURS = 0x757u;   // bits of the places around the middle one of 3 x 3, in rows of four

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
    bool even;
    uint left = NEIGHBOURS;
    do {   // a loop that drivers do not unroll
        int i = findLSB(left);
        left &= left - 1u;
        even = shows_the_same(pixel + ivec2(i & 3, i >> 2) - 1, real, position, normal);
    } while (left != 0u && even);
    return even;
#endif
}

bool may_be_thin(vec2 place) {
    uint marks = 0u;
    for (int i = 0; i < 4; ++i) marks |= tiles[tile_around(place, i, 0)].marks;
    return (marks & THIN) != 0u;
}

void main() {
    ivec2 inside = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(inside, rectangle.zw))) return;
    ivec2 pixel = rectangle.xy + inside, raster = sampled_texel(pixel);
    vec2 place = place_in_raster(pixel);
    vec4 position = position_at(raster);
    bool is_covered = position.w > 0.0, even = !may_be_thin(place) && is_even(pixel, position, normal_at(raster));
    vec4 sample_here = is_covered ? covered(in_front(pixel, position.w) > 0.0, position.w) : vec4(0.0);
    copy_surface(pixel, raster, position);
    imageStore(sample_coverage, pixel, (even ? 1.0 : weight) * sample_here);
    imageStore(second_surface, pixel, vec4(0.0));
    if (even) return;
    append_texel(pixel, int(picture_size.x));
    for (int i = 0; i < 4; ++i) atomicOr(tiles[tile_around(place, i, 0)].marks, UNEVEN);
}
