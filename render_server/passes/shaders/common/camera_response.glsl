// Codes of the camera for linear values.
uniform sampler2D inverse_response;   // uniform in the square root, where codes are about evenly spaced
#pragma texels rgba32f inverse_response

// Camera code of each channel of a linear value times exposure.
uvec3 encode(vec3 x) {
    int last = textureSize(inverse_response, 0).x - 1;
    ivec3 at = ivec3(round(sqrt(clamp(x, 0.0, 1.0)) * float(last)));
    return uvec3(round(vec3(
        texelFetch(inverse_response, ivec2(at.r, 0), 0).r, texelFetch(inverse_response, ivec2(at.g, 0), 0).g,
        texelFetch(inverse_response, ivec2(at.b, 0), 0).b)));
}
