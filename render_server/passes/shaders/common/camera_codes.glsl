// A picture of the camera: its codes, and the linear radiance that each of them stands for.
uniform usampler2D picture;
uniform sampler2D code_radiance;   // 256 x 1, camera units: B_lin = response^-1(B) / exposure (docs/method.md 1)
#pragma texels rgba8ui picture
#pragma texels rgba16f code_radiance

vec3 radiance_of(uvec3 code) {
    return vec3(
        texelFetch(code_radiance, ivec2(int(code.r), 0), 0).r, texelFetch(code_radiance, ivec2(int(code.g), 0), 0).g,
        texelFetch(code_radiance, ivec2(int(code.b), 0), 0).b);
}
