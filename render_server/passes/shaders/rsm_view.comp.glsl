// The reflective shadow maps: what the lights see of the real scene (left) and of the objects (right), as normals.
#include "common/pixel_group.glsl"
layout(rgba8ui) writeonly uniform uimage2D code_out;
uniform sampler2D real_rsm_normal;
uniform sampler2D object_rsm_normal;
uniform sampler2D real_rsm_depth;
uniform sampler2D object_rsm_depth;

// Nearest texel of a map fitted into a box of `size` pixels.
uvec4 shown(sampler2D normal, sampler2D depth, vec2 at, vec2 size) {
    vec2 extent = vec2(textureSize(normal, 0));
    float zoom = max(extent.x / size.x, extent.y / size.y);
    vec2 texel = (at - 0.5 * size) * zoom + 0.5 * extent;
    if (any(lessThan(texel, vec2(0.0))) || any(greaterThanEqual(texel, extent))) return uvec4(16u, 16u, 16u, 255u);
    if (texelFetch(depth, ivec2(texel), 0).r >= 1.0) return uvec4(0u, 0u, 0u, 255u);
    return uvec4(round(255.0 * (0.5 + 0.5 * texelFetch(normal, ivec2(texel), 0).xyz)), 255u);
}

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    ivec2 size = imageSize(code_out);
    if (any(greaterThanEqual(pixel, size))) return;
    vec2 half_size = vec2(0.5 * float(size.x), float(size.y));
    vec2 at = vec2(pixel) + 0.5;
    bool left = at.x < half_size.x;
    uvec4 code = left ? shown(real_rsm_normal, real_rsm_depth, at, half_size)
                      : shown(object_rsm_normal, object_rsm_depth, at - vec2(half_size.x, 0.0), half_size);
    imageStore(code_out, pixel, code);
}
