// Irradiance by what objects in other volumes change of the light (docs/method.md 5.9). Needs volume.glsl.
#ifdef SEVERAL_VOLUMES
#include "common/light_sources.glsl"
uniform sampler2D light_sources;
#pragma texels rgba32f light_sources

// Intensity of a source towards d: even light, and a cosine lobe for what has a direction. `gains`: 1, or -1 of light lost.
float intensity_of(vec4 flux, vec3 d, float gains) {
    return (flux.w - gains * length(flux.xyz)) / (4.0 * PI) + gains * max(gains * dot(flux.xyz, d), 0.0) / PI;
}

vec3 from_source(int row, int first, float gains, vec3 p, vec3 n) {
    vec4 place = texelFetch(light_sources, ivec2(first + 3, row), 0);
    if (place.w <= 0.0) return vec3(0.0);
    vec3 way = p - place.xyz / place.w;
    float apart2 = max(dot(way, way), voxel_edge * voxel_edge);
    vec3 d = way * inversesqrt(apart2), sum;
    for (int channel = 0; channel < 3; ++channel)
        sum[channel] = intensity_of(texelFetch(light_sources, ivec2(first + channel, row), 0), d, gains);
    return sum * max(-dot(n, d), 0.0) / apart2;
}

// At p (world, m) of the volume in which the thread works.
vec3 from_other_volumes(vec3 p, vec3 n) {
    vec3 sum = vec3(0.0);
    for (int row = 0; row < volume_count; ++row) {
        float arriving = texelFetch(light_sources, ivec2(2 * SOURCE_TEXELS, row), 0)[volume];
        if (arriving == 0.0) continue;
        sum += arriving * (from_source(row, 0, 1.0, p, n) + from_source(row, SOURCE_TEXELS, -1.0, p, n));
    }
    return sum;
}
#else
vec3 from_other_volumes(vec3 p, vec3 n) { return vec3(0.0); }
#endif
