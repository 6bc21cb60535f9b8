// Irradiance of cones at the objects, and of smooth caustics, as the last frame knows them.
#include "common/geometry.glsl"
#include "common/reprojection.glsl"
#include "common/object_history.glsl"
#include "common/work_list.glsl"

layout(local_size_x = 64) in;
uniform isampler2D sample_pixels;
uniform usampler2D stale_texels;
#ifdef CAUSTICS
#define ADDS_CAUSTICS
#include "common/caustic_sums.glsl"
layout(std430) readonly buffer LastSums { int last_sums[]; };
#else
uniform sampler2D last_irradiance;
layout(rgba16f) writeonly uniform image2D irradiance;
#endif

void reuse(ivec2 texel) {
    ivec2 raster = raster_texel(texelFetch(sample_pixels, texel, 0).zw);
    vec4 position = texelFetch(virtual_raster_position, raster, 0);
    LastTexels last = last_object_texels(position, texelFetch(virtual_raster_normal, raster, 0).xyz);
    vec4 sum = vec4(0.0);
    for (int j = 0; j < 4; ++j) {
        if (last.weights[j] == 0.0) continue;
        ivec2 from = last.base + ivec2(j & 1, j >> 1);
#ifdef CAUSTICS
        int at = sums_of_texel(from, textureSize(sample_pixels, 0), ivec2(picture_size)) + OBJECT_LAYER;
        sum.rgb += last.weights[j] * vec3(last_sums[at], last_sums[at + 1], last_sums[at + 2]);
#else
        sum += last.weights[j] * texelFetch(last_irradiance, from, 0);
#endif
    }
#ifdef CAUSTICS
    int to = sums_of_texel(texel, textureSize(sample_pixels, 0), ivec2(picture_size)) + OBJECT_LAYER;
    for (int i = 0; i < 3; ++i) caustic_sums[to + i] = int(round(sum[i]));
#else
    imageStore(irradiance, texel, sum);
#endif
}

void main() {
    int grid_width = textureSize(sample_pixels, 0).x;
    for (uint i = gl_GlobalInvocationID.x; i < listed_count(); i += gl_NumWorkGroups.x * 64u) {
        ivec2 texel = texel_of_index(texels[i], grid_width);
        if ((texelFetch(stale_texels, texel, 0).r & STALE_OBJECT) == 0u) reuse(texel);
    }
}
