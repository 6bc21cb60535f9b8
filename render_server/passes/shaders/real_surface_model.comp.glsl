// Real geometry buffer from a given model or the fused surface: its raster, sampled through the lens model.
#include "common/geometry.glsl"
#include "common/measured_surfaces.glsl"

#include "common/pixel_group.glsl"
uniform sampler2D model_raster_position;   // like the objects' raster (common/geometry.glsl)
uniform sampler2D model_raster_normal;
layout(rgba32f) uniform image2D position_out;
layout(rgba16f) writeonly uniform image2D normal_out;
uniform bool keeps_depth;     // the frame's own depth is present, and stays where it differs
uniform vec2 tolerance;       // up to which both agree: m, and m at 1 m

#ifdef DECLARED_SURFACES
int entry_of(vec4 position, vec4 seen) {
    int entry = measured_entry(0, position.xyz, position.w, seen.xyz, seen.w);
    while (entry >= 0 && surfaces[entry].region[0].w == PLANE && is_off_plane(surfaces[entry], plane_fits[entry], position.xyz, position.w))
        entry = measured_entry(entry + 1, position.xyz, position.w, seen.xyz, seen.w);
    return entry;
}
#else
int entry_of(vec4 position, vec4 seen) { return -1; }
#endif

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, imageSize(position_out)))) return;
    ivec2 raster = raster_texel(pixel);
    vec4 position = vec4(0.0);
    vec4 normal = vec4(0.0, 0.0, 1.0, -1.0);
    if (all(greaterThanEqual(raster, ivec2(0))) && all(lessThan(raster, textureSize(model_raster_position, 0)))) {
        position = texelFetch(model_raster_position, raster, 0);
        vec4 seen = texelFetch(model_raster_normal, raster, 0);
        normal = vec4(seen.xyz, position.w > 0.0 ? float(entry_of(position, seen)) : -1.0);
    }
    float own = keeps_depth ? imageLoad(position_out, pixel).w : 0.0;
    if (own > 0.0 && abs(position.w - own) > tolerance.x + tolerance.y * own * own) return;
    imageStore(position_out, pixel, position);
    imageStore(normal_out, pixel, normal);
}
