// For each texel of the reduced grid, the picture pixel nearest to its centre that shows a real surface with depth,
// and the one that shows a virtual object. Where objects hide all real surfaces, one of these as -2 - pixel. Lists the texels that show
// an object, and those in which objects may change the direct light of a pixel. CONES: also those from whose real surface cones are
// to be traced; from the others, objects change nothing.
#include "common/light_reach.glsl"
#define APPENDS_TEXELS
#include "common/work_list.glsl"
#define APPENDS_PIXELS
#include "common/shown_pixels.glsl"

#include "common/pixel_group.glsl"
layout(rgba16i) writeonly uniform iimage2D sample_pixels_out;
uniform sampler2D object_coverage;
#pragma texels r16f object_coverage
uniform ivec2 picture_pixels;
uniform int scale;

#ifdef QUADS
// Of each quad in the texels that show an object, the pixel that stands for it; as ShownPixels.
layout(std430) buffer Quads { uint quad_count; uint quad_pixels[]; };
#include "common/quads.glsl"

void append_quads(ivec2 texel) {
    int edge = (scale + 1) / 2;
    for (int i = 0; i < edge * edge; ++i) {
        ivec2 pixel = first_of_quad(texel * scale / 2 + ivec2(i % edge, i / edge));
        if (pixel.x >= 0) quad_pixels[atomicAdd(quad_count, 1u)] = packed_pixel(pixel);
    }
}
#endif

layout(std430) buffer Reached { uint reached_count; uint reached_texels[]; };   // as Texels

// What the pixels of a texel show of the real scene; nearest > deepest: nothing.
struct Block { vec3 low; vec3 high; float nearest; float deepest; bool reached; };

ivec2 block_pixel(ivec2 texel, int i) { return min(pixel_in_block(texel, i, scale), picture_pixels - 1); }

// Until a pixel is found in which cones change light, or light is asked for.
Block block_at(ivec2 texel) {
    Block b = Block(vec3(1e30), vec3(-1e30), 1e30, 0.0, false);
    for (int i = 0; i < scale * scale && !b.reached; ++i) {
        ivec2 pixel = block_pixel(texel, i);
        vec4 position = texelFetch(real_surface_position, pixel, 0);
        if (position.w <= 0.0) continue;
        b = Block(min(b.low, position.xyz), max(b.high, position.xyz), min(b.nearest, position.w), max(b.deepest, position.w),
            is_in_lit_area(pixel) || cones_may_reach(position, texelFetch(real_surface_normal, pixel, 0).xyz));
    }
    return b;
}

bool shadow_reaches_pixel(ivec2 pixel) {
    vec4 position = texelFetch(real_surface_position, pixel, 0);
    vec3 normal = texelFetch(real_surface_normal, pixel, 0).xyz;
    return position.w > 0.0 && shadow_may_reach(position.xyz, normal, shadow_bias(position.w));
}

void append_reached(ivec2 texel, int width) {
    Block b = block_at(texel);
    bool reached = b.reached;
    // Most blocks are far from every shadow, as their bounds tell.
    bool near = !reached && b.nearest <= b.deepest
        && shadow_may_reach_sphere(0.5 * (b.low + b.high), 0.5 * distance(b.low, b.high), shadow_bias(b.nearest));
    for (int i = 0; i < (near ? scale * scale : 0) && !reached; ++i) reached = shadow_reaches_pixel(block_pixel(texel, i));
    if (reached) reached_texels[atomicAdd(reached_count, 1u)] = uint(texel.y * width + texel.x);
}

// Lists the `count` pixels of a texel that show an object.
void append_shown(ivec2 texel, uint count) {
    uint place = count > 0u ? room_for_pixels(count) : 0u;
    for (int i = 0; i < (count > 0u ? scale * scale : 0); ++i) {
        ivec2 pixel = pixel_in_block(texel, i, scale);
        if (all(lessThan(pixel, picture_pixels)) && texelFetch(object_coverage, pixel, 0).r > 0.0)
            put_pixel(place++, pixel);
    }
}

#ifdef CONES
layout(r8ui) writeonly uniform uimage2D cone_reach_out;   // 1 in the texels listed
layout(std430) buffer ConeTexels { uint traced_count; uint traced_texels[]; };   // as Texels
uniform bool hidden_too;   // as in low_res_grid.glsl

bool cones_reach(ivec2 pixel) {
    vec3 position = texelFetch(real_surface_position, pixel, 0).xyz;
    enter_volume(position);
    return is_in_lit_area(pixel) || volume_fade(volume_coordinate(position)) > 0.0 || object_may_shadow(position, 0.0, true);
}

void append_traced(ivec2 texel, ivec2 real, int width) {
    if (hidden_too && real.x < -1) real = -2 - real;
    bool reached = real.x >= 0 && cones_reach(real);
    imageStore(cone_reach_out, texel, uvec4(reached));
    if (reached) traced_texels[atomicAdd(traced_count, 1u)] = uint(texel.y * width + texel.x);
}
#endif

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    ivec2 low = (picture_pixels + scale - 1) / scale;
    if (any(greaterThanEqual(texel, low))) return;
    ivec4 best = ivec4(-1);
    ivec2 hidden = ivec2(-1);
    vec3 nearest = vec3(1e9);
    uint shown_here = 0u;
    for (int j = 0; j < scale; ++j)
        for (int i = 0; i < scale; ++i) {
            ivec2 pixel = texel * scale + ivec2(i, j);
            if (any(greaterThanEqual(pixel, picture_pixels))) continue;
            vec2 d = vec2(i, j) - 0.5 * float(scale - 1);
            float away = dot(d, d);
            float shown = texelFetch(object_coverage, pixel, 0).r;
            shown_here += uint(shown > 0.0);
            bool known = texelFetch(real_surface_position, pixel, 0).w > 0.0;
            if (away < nearest.x && shown < 1.0 && known) { nearest.x = away; best.xy = pixel; }
            if (away < nearest.z && shown == 1.0 && known) { nearest.z = away; hidden = -2 - pixel; }
            if (away < nearest.y && shown > 0.0) { nearest.y = away; best.zw = pixel; }
        }
    if (best.x < 0) best.xy = hidden;
    imageStore(sample_pixels_out, texel, best);
    if (best.z >= 0) append_texel(texel, low.x);
#ifdef QUADS
    if (best.z >= 0) append_quads(texel);
#endif
    append_shown(texel, shown_here);
    append_reached(texel, low.x);
#ifdef CONES
    append_traced(texel, best.xy, low.x);
#endif
}
