// Camera code -> linear camera units: B_lin = response^-1(B) / exposure (docs/method.md 1). a = 0 where a channel is
// clipped.
layout(local_size_x = 8, local_size_y = 8) in;
uniform usampler2D picture;
uniform sampler2D response;        // 256 x 1, linear RGB of each code
layout(rgba16f) writeonly uniform image2D linear_out;
uniform float exposure_scale;

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, textureSize(picture, 0)))) return;
    uvec3 code = texelFetch(picture, pixel, 0).rgb;
    vec3 linear;
    for (int i = 0; i < 3; ++i) linear[i] = texelFetch(response, ivec2(int(code[i]), 0), 0)[i];
    bool clipped = any(equal(code, uvec3(255u)));
    imageStore(linear_out, pixel, vec4(linear / exposure_scale, clipped ? 0.0 : 1.0));
}
