// A picture of the camera's size from a relit one that is smaller: what it shows, and the camera's own detail, in codes. Where the
// objects change nothing, the camera's bytes.
#include "common/pixel_group.glsl"
uniform usampler2D picture;             // the camera's
uniform usampler2D small_picture;       // the same, smaller
uniform usampler2D small_composite;
uniform sampler2D object_coverage;      // of the small picture
#pragma texels rgba8ui picture
#pragma texels r16f object_coverage
layout(rgba8ui) writeonly uniform uimage2D code_out;

const float GREATEST_RATIO = 4.0;       // of codes: noise of dark pixels must not be amplified further

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy), size = textureSize(picture, 0), last = textureSize(small_picture, 0) - 1;
    if (any(greaterThanEqual(pixel, size))) return;
    vec2 at = (vec2(pixel) + 0.5) * vec2(last + 1) / vec2(size) - 0.5, f = fract(at);
    vec3 before = vec3(0.0), after = vec3(0.0), ratio = vec3(0.0);
    float covered = 0.0;
    bool changed = false;
    for (int j = 0; j < 4; ++j) {
        ivec2 from = clamp(ivec2(floor(at)) + ivec2(j & 1, j >> 1), ivec2(0), last);
        float w = ((j & 1) == 1 ? f.x : 1.0 - f.x) * ((j >> 1) == 1 ? f.y : 1.0 - f.y);
        uvec3 own = texelFetch(small_picture, from, 0).rgb, relit = texelFetch(small_composite, from, 0).rgb;
        float coverage = texelFetch(object_coverage, from, 0).r;
        changed = changed || own != relit;
        before += w * vec3(own);
        after += w * vec3(relit);
        covered += w * coverage;
        ratio += w * (coverage > 0.0 ? vec3(1.0) : min(vec3(relit) / max(vec3(own), vec3(1.0)), vec3(GREATEST_RATIO)));
    }
    vec3 code = vec3(texelFetch(picture, pixel, 0).rgb);
    // Ratios of codes are ratios of light raised to the power of the response, as long as that is about a power.
    vec3 shown = after + (1.0 - covered) * ratio * (code - before);
    imageStore(code_out, pixel, uvec4(changed ? uvec3(round(clamp(shown, 0.0, 255.0))) : uvec3(code), 255u));
}
