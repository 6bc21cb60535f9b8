// Where cones and caustics must be computed at each texel of the reduced grid: where the last frame did not see the
// texel's surface, on objects that moved; and in turn, one tile in `turns`, so that errors of resampling do not add up. Keeps the points that
// the next frame looks up. With REUSES_IRRADIANCE, fills in the irradiance of cones where it need not be computed (at objects, a: 1
// where it is known), and lists the texels from whose real surface they are to be traced.
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
uniform usampler2D cone_reach;   // 1 where cones are to gather light at real surfaces
uniform sampler2D last_cone_mu;  // a: 1 where they did
uniform sampler2D last_cone_rho;
uniform sampler2D last_irradiance;
layout(rgba16f) writeonly uniform image2D kept_mu;
layout(rgba16f) writeonly uniform image2D kept_rho;
layout(rgba16f) writeonly uniform image2D kept_irradiance;
layout(std430) buffer StaleCones { uint traced_count; uint traced_texels[]; };   // as Texels

// Of a real surface that cones are to reach; `known`: if the last frame's texels have all of its light.
void keep_or_list_cones(ivec2 texel, bool known, LastTexels last) {
    vec4 mu = vec4(0.0), rho = vec4(0.0);
    for (int j = 0; j < (known ? 4 : 0); ++j) {
        if (last.weights[j] == 0.0) continue;
        ivec2 from = last.base + ivec2(j & 1, j >> 1);
        vec4 light = texelFetch(last_cone_mu, from, 0);
        known = light.a >= 0.5;
        mu += last.weights[j] * light;
        rho += last.weights[j] * texelFetch(last_cone_rho, from, 0);
    }
    if (known) {
        imageStore(kept_mu, texel, vec4(mu.rgb, 1.0));
        imageStore(kept_rho, texel, rho);
    } else
        traced_texels[atomicAdd(traced_count, 1u)] = uint(texel.y * textureSize(sample_pixels, 0).x + texel.x);
}

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
    LastTexels last = seen_last(object, object_normal, true), last_real = seen_last(real, real_normal, false);
    uint stale = due || is_unknown(real, last_real) ? STALE_REAL : 0u;
    if (object.w > 0.0 && (due || objects_moved || is_unknown(object, last))) stale |= STALE_OBJECT;
#ifdef REUSES_IRRADIANCE
    keep_irradiance(texel, object.w > 0.0 && (stale & STALE_OBJECT) == 0u, last);
    if (texelFetch(cone_reach, texel, 0).r != 0u) keep_or_list_cones(texel, (stale & STALE_REAL) == 0u, last_real);
#endif
    imageStore(stale_out, texel, uvec4(stale));
    imageStore(real_texels_out, texel, real);
    imageStore(object_texels_out, texel, object);
}
