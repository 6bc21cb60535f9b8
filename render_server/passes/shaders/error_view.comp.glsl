// [P1] eq. 9 in the colours of [P1] fig. 3: the channel of E / pi, the radiance of a white surface, that differs most, squared
// and enhanced. Black, red, yellow where the relit picture is too dark, black, blue, white where it is too bright.
#include "common/pixel_group.glsl"
layout(rgba8ui) writeonly uniform uimage2D code_out;
uniform sampler2D delta_error;   // rgb E at 1/scale of the picture, a: 1 where known
uniform bool has_error;
uniform int scale;

const float ENHANCED = 65536.0;   // the brightest colour is an error of 1/256 of the camera's white
const float PER_IRRADIANCE = 0.31830988618;

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, imageSize(code_out)))) return;
    vec3 error = vec3(0.0);
    if (has_error) error = texelFetch(delta_error, min(pixel / scale, textureSize(delta_error, 0) - 1), 0).rgb;
    float most = error.r;
    if (abs(error.g) > abs(most)) most = error.g;
    if (abs(error.b) > abs(most)) most = error.b;
    most *= PER_IRRADIANCE;
    float strength = min(ENHANCED * most * most, 1.0);
    float first = min(2.0 * strength, 1.0), second = max(2.0 * strength - 1.0, 0.0);
    vec3 colour = most > 0.0 ? vec3(first, second, 0.0) : vec3(second, second, first);
    imageStore(code_out, pixel, uvec4(round(255.0 * colour), 255u));
}
