// Where cones and caustics must be computed at each texel of the reduced grid: where the last frame did not see the
// texel's surface, on objects that moved; and in turn, one tile in `turns`, so that errors of resampling do not add up. Keeps the points that
// the next frame looks up. With REUSES_IRRADIANCE, fills in the irradiance of cones at objects (a: 1 where it is known) where it
// need not be computed.
#include "common/geometry.glsl"
#include "common/reprojection.glsl"
#include "common/last_texels.glsl"

#include "common/pixel_group.glsl"
uniform isampler2D sample_pixels;
#pragma texels rgba16i sample_pixels
layout(r8ui) writeonly uniform uimage2D stale_out;
layout(rgba32f) writeonly uniform image2D real_texels_out;
layout(rgba32f) writeonly uniform image2D object_texels_out;
uniform bool objects_moved;
#pragma switch REUSES_IRRADIANCE
#ifdef REUSES_IRRADIANCE
uniform sampler2D last_irradiance;
layout(rgba16f) writeonly uniform image2D kept_irradiance;

void keep_irradiance(ivec2 texel, bool known, LastTexels last) {
    vec3 sum = vec3(0.0);
    for (int j = 0; j < (known ? 4 : 0); ++j)
        if (last.weights[j] != 0.0) sum += last.weights[j] * texelFetch(last_irradiance, last.base + ivec2(j & 1, j >> 1), 0).rgb;
    imageStore(kept_irradiance, texel, vec4(sum, float(known)));
}
#endif

LastTexels seen_last(vec4 position, vec3 normal, bool object) {
    if (has_history && position.w > 0.0) return last_texels(position, normal, object);
    return LastTexels(ivec2(0), vec4(0.0), 0.0);
}

bool is_unknown(vec4 position, LastTexels last) { return position.w > 0.0 && last.total < LEAST_WEIGHT; }

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, textureSize(sample_pixels, 0)))) return;
    ivec4 pixels = texelFetch(sample_pixels, texel, 0);
    if (pixels.x < -1) pixels.xy = -2 - pixels.xy;
    vec4 real = vec4(0.0), object = vec4(0.0);
    vec3 real_normal = vec3(0.0), object_normal = vec3(0.0);
    if (pixels.x >= 0) {
        real = texelFetch(real_surface_position, pixels.xy, 0);
        real_normal = texelFetch(real_surface_normal, pixels.xy, 0).xyz;
    }
    if (pixels.z >= 0) {
        ivec2 raster = raster_texel(pixels.zw);
        object = texelFetch(virtual_raster_position, raster, 0);
        object_normal = texelFetch(virtual_raster_normal, raster, 0).xyz;
    }
    bool due = is_due(texel);
    LastTexels last = seen_last(object, object_normal, true);
    uint stale = due || is_unknown(real, seen_last(real, real_normal, false)) ? STALE_REAL : 0u;
    if (object.w > 0.0 && (due || objects_moved || is_unknown(object, last))) stale |= STALE_OBJECT;
#ifdef REUSES_IRRADIANCE
    keep_irradiance(texel, object.w > 0.0 && (stale & STALE_OBJECT) == 0u, last);
#endif
    imageStore(stale_out, texel, uvec4(stale));
    imageStore(real_texels_out, texel, real);
    imageStore(object_texels_out, texel, object);
}
