// Direct light of the last frame in the texels that low_res_grid listed, at the pixels that see the same surfaces
// as then, and no edge of a shadow. Lists the texels that have others; and in turn one tile in `turns`, so that errors of
// resampling do not add up. Where objects moved, these are also those that keep all of their light without the objects, and that
// no shadow reaches: listed apart in software, where they would wait for the loop over lights of others.
#include "common/light_reach.glsl"
#include "common/reprojection.glsl"
#include "common/work_list.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image2D direct_mu_out;
layout(rgba16f) writeonly uniform image2D direct_rho_out;
layout(std430) buffer Needed { uint needed_count; uint needed[]; };   // as Texels
#ifdef SOFTWARE
layout(std430) buffer Spared { uint spared_count; uint spared[]; };   // as Texels
#endif
uniform sampler2D last_direct_mu;
uniform sampler2D last_direct_rho;
uniform ivec2 low_resolution_size;
uniform int scale;
uniform bool keeps_unblocked;   // where a pixel shows the same point: its light without the objects

// Change of the ratio of irradiances from pixel to pixel, from which on it is an edge: it would blur.
const float SHARPEST = 0.04;

// Whether the last frame saw this pixel's surface, and no edge of a shadow there; then `mu` and `rho` are its light.
bool remembered(vec4 position, vec3 normal, out vec4 mu, out vec4 rho) {
    mu = rho = vec4(0.0);
    vec2 at = last_pixel(position.xyz) - 0.5;
    float total = 0.0, least = 1e9, most = 0.0;
    for (int j = 0; j < 4; ++j) {
        ivec2 pixel = ivec2(floor(at)) + ivec2(j & 1, j >> 1);
        float w = bilinear(at, j) * same_surface(pixel, position, normal);
        if (w <= 0.0) continue;
        vec4 one_mu = texelFetch(last_direct_mu, pixel, 0), one_rho = texelFetch(last_direct_rho, pixel, 0);
        float ratio = (one_rho.r + one_rho.g + one_rho.b + 1e-4) / (one_mu.r + one_mu.g + one_mu.b + 1e-4);
        least = min(least, ratio);
        most = max(most, ratio);
        total += w;
        mu += w * one_mu;
        rho += w * one_rho;
    }
    mu /= max(total, 1e-6);
    rho /= max(total, 1e-6);
    return total > LEAST_WEIGHT && most - least < SHARPEST;
}

// Whether a pixel's light is the last frame's.
bool reproject(ivec2 pixel) {
    vec4 position = texelFetch(real_surface_position, pixel, 0), mu = vec4(0.0), rho = vec4(0.0);
    bool kept = has_history && remembered(position, texelFetch(real_surface_normal, pixel, 0).xyz, mu, rho);
    imageStore(direct_mu_out, pixel, mu);
    imageStore(direct_rho_out, pixel, rho);
    return kept || position.w <= 0.0;
}

// What the pixels of a texel show of the real scene, and whether all of them keep their light.
struct Block { vec3 low; vec3 high; float nearest; bool kept; };

void keep_unblocked(ivec2 pixel, inout Block b) {
    vec4 position = texelFetch(real_surface_position, pixel, 0);
    bool same = texelFetch(last_position, pixel, 0) == position;
    vec4 mu = same ? texelFetch(last_direct_mu, pixel, 0) : vec4(0.0);
    imageStore(direct_mu_out, pixel, mu);
    if (position.w <= 0.0) return;
    b = Block(min(b.low, position.xyz), max(b.high, position.xyz), min(b.nearest, position.w), b.kept && mu.a > 0.0);
}

bool shadows_may_reach(Block b) {
    return shadow_may_reach_sphere(0.5 * (b.low + b.high), 0.5 * distance(b.low, b.high), shadow_bias(b.nearest));
}

void list_needed(uint texel) { needed[atomicAdd(needed_count, 1u)] = texel; }

#ifdef SOFTWARE
void list_spared(uint texel) { spared[atomicAdd(spared_count, 1u)] = texel; }
#else
void list_spared(uint texel) { list_needed(texel); }
#endif

void main() {
    ivec2 size = textureSize(real_surface_position, 0);
    for (uint i = first_item(); i < listed_count(); i += items_apart()) {
        ivec2 texel = texel_of_index(texels[i], low_resolution_size.x);
        bool known = !is_due(texel);
        for (int j = 0; j < (has_history ? scale * scale : 0); ++j) {
            ivec2 pixel = pixel_in_block(texel, j, scale);
            if (all(lessThan(pixel, size))) known = reproject(pixel) && known;
        }
        Block b = Block(vec3(1e30), vec3(-1e30), 1e30, true);
        for (int j = 0; j < (keeps_unblocked ? scale * scale : 0); ++j) {
            ivec2 pixel = pixel_in_block(texel, j, scale);
            if (all(lessThan(pixel, size))) keep_unblocked(pixel, b);
        }
        bool is_spared = keeps_unblocked && b.kept && b.nearest < 1e30 && !shadows_may_reach(b);
        if (is_spared) list_spared(texels[i]);
        else if (!has_history || !known) list_needed(texels[i]);
    }
}
