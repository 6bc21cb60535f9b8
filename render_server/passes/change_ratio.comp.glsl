// How light changed on the reduced grid. RATIO: E_rho / E_mu at each texel's pixel. Otherwise: whether anything within
// FILL_RADIUS texels changed at all, so that composition can pass over the rest of the picture.
layout(local_size_x = 8, local_size_y = 8) in;
layout(binding = 0, rgba16f) writeonly uniform image2D result;
layout(binding = 0) uniform isampler2D sample_pixels;
layout(binding = 1) uniform sampler2D direct_mu;
layout(binding = 2) uniform sampler2D direct_rho;
layout(binding = 3) uniform sampler2D cone_mu;
layout(binding = 8) uniform sampler2D cone_rho;
layout(binding = 9) uniform sampler2D ratios;
layout(binding = 16) uniform sampler2D specular_mu;
layout(binding = 17) uniform sampler2D specular_rho;

const float LEAST_IRRADIANCE = 1e-4;

#ifdef RATIO
// rgb: ratio; a: 0 no real surface, 1 unchanged, 2 changed.
vec4 value(ivec2 texel) {
    ivec2 at = texelFetch(sample_pixels, texel, 0).xy;
    if (at.x < 0) return vec4(1.0, 1.0, 1.0, 0.0);
    vec4 rho = texelFetch(cone_rho, texel, 0), mu = texelFetch(cone_mu, texel, 0);
    vec3 e_mu = texelFetch(direct_mu, at, 0).rgb + mu.rgb;
    vec3 e_rho = texelFetch(direct_rho, at, 0).rgb + mu.rgb + rho.a * (rho.rgb - mu.rgb);
    bool changed = e_mu != e_rho || texelFetch(specular_mu, texel, 0) != texelFetch(specular_rho, texel, 0);
    return vec4((e_rho + LEAST_IRRADIANCE) / (e_mu + LEAST_IRRADIANCE), changed ? 2.0 : 1.0);
}
#else
vec4 value(ivec2 texel) {
    ivec2 last = textureSize(ratios, 0) - 1;
    float near = 0.0;
    for (int j = -FILL_RADIUS; j <= FILL_RADIUS; ++j)
        for (int i = -FILL_RADIUS; i <= FILL_RADIUS; ++i)
            near = max(near, texelFetch(ratios, clamp(texel + ivec2(i, j), ivec2(0), last), 0).a);
    return vec4(near > 1.5 ? 1.0 : 0.0);
}
#endif

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, textureSize(sample_pixels, 0)))) return;
    imageStore(result, texel, value(texel));
}
