// One picture going over into another, in codes. Where both show the same, so does this.
#include "common/pixel_group.glsl"
uniform usampler2D before;
uniform usampler2D after;
uniform float weight;      // of `after`
layout(rgba8ui) writeonly uniform uimage2D code_out;

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, textureSize(after, 0)))) return;
    vec4 code = mix(vec4(texelFetch(before, pixel, 0)), vec4(texelFetch(after, pixel, 0)), weight);
    imageStore(code_out, pixel, uvec4(round(code)));
}
