// The change due to relighting. EFFECTS: objects and the change of light on mid grey. Otherwise the signed change
// alone: gained light in its own colour, lost light as red, both amplified; objects black.
#include "common/srgb.glsl"

#include "common/pixel_group.glsl"
layout(rgba8ui) writeonly uniform uimage2D code_out;
uniform sampler2D linear_picture;
uniform sampler2D relit;
uniform sampler2D object_coverage;
#pragma texels rgba16f linear_picture
#pragma texels r16f object_coverage

const float MID_GREY = 0.2140;   // linear value of sRGB code 127
const float ENLARGED = 4.0;

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, textureSize(linear_picture, 0)))) return;
    vec3 result = texelFetch(relit, pixel, 0).rgb;
    vec3 change = result - texelFetch(linear_picture, pixel, 0).rgb;
    float shown = texelFetch(object_coverage, pixel, 0).r;
#ifdef EFFECTS
    vec3 colour = mix(MID_GREY + change, result, shown);
#else
    vec3 lost = max(-change, 0.0);
    vec3 colour = (max(change, 0.0) + vec3(max(lost.r, max(lost.g, lost.b)), 0.0, 0.0)) * ENLARGED * (1.0 - shown);
#endif
    imageStore(code_out, pixel, srgb(colour));
}
