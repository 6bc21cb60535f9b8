// Direct light of the last frame at the pixels that see the same surfaces as then, and a list of the texels of the
// reduced grid that need it anew: those with a pixel that sees another surface or the edge of a shadow, and, in turn,
// one tile in `turns`, so that errors of resampling do not add up.
#include "common/geometry.glsl"
#define APPENDS_TEXELS
#include "common/work_list.glsl"
#include "common/reprojection.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
layout(rgba32f) writeonly uniform image2D position_out;
layout(rgba16f) writeonly uniform image2D direct_mu_out;
layout(rgba16f) writeonly uniform image2D direct_rho_out;
uniform sampler2D last_direct_mu;
uniform sampler2D last_direct_rho;
uniform int scale;

shared uint stale[64];

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

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy), size = textureSize(real_surface_position, 0);
    ivec2 inside = ivec2(gl_LocalInvocationID.xy) / scale;
    uint slot = uint(inside.y * 8 + inside.x);
    stale[gl_LocalInvocationIndex] = 0u;
    memoryBarrierShared();
    barrier();
    if (all(lessThan(pixel, size))) {
        vec4 position = texelFetch(real_surface_position, pixel, 0), mu, rho;
        bool known = position.w > 0.0;
        bool kept = has_history && known && remembered(position, texelFetch(real_surface_normal, pixel, 0).xyz, mu, rho);
        if (kept) {
            imageStore(direct_mu_out, pixel, mu);
            imageStore(direct_rho_out, pixel, rho);
        }
        if (!kept && (known || !has_history)) atomicOr(stale[slot], 1u);
        imageStore(position_out, pixel, position);
    }
    memoryBarrierShared();
    barrier();
    bool first = all(equal(ivec2(gl_LocalInvocationID.xy), inside * scale));
    ivec2 texel = pixel / scale, grid = (size + scale - 1) / scale;
    if (!first || any(greaterThanEqual(texel, grid))) return;
    if (stale[slot] != 0u || is_due(texel)) append_texel(texel, grid.x);
}
