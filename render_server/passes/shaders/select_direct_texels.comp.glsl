// Lists the texels of the reduced grid in which objects may change the direct light of a pixel.
#include "common/light_reach.glsl"
#define APPENDS_TEXELS
#include "common/work_list.glsl"

#include "common/pixel_group.glsl"
uniform ivec2 low_resolution_size;
uniform int scale;

// What the pixels of a texel show of the real scene; nearest > deepest: nothing.
struct Block { vec3 low; vec3 high; float nearest; float deepest; bool reached; };

ivec2 block_pixel(ivec2 texel, int i) {
    return min(pixel_in_block(texel, i, scale), textureSize(real_surface_position, 0) - 1);
}

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

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, low_resolution_size))) return;
    Block b = block_at(texel);
    bool reached = b.reached;
    // Most blocks are far from every shadow, as their bounds tell.
    bool near = !reached && b.nearest <= b.deepest
        && shadow_may_reach_sphere(0.5 * (b.low + b.high), 0.5 * distance(b.low, b.high), shadow_bias(b.nearest));
    for (int i = 0; i < (near ? scale * scale : 0) && !reached; ++i) reached = shadow_reaches_pixel(block_pixel(texel, i));
    if (reached) append_texel(texel, low_resolution_size.x);
}
