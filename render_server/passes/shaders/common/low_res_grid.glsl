// The picture pixel that represents each texel of the reduced grid, and the surface that it shows: REAL, that of the real scene;
// otherwise the objects'. BOTH: `real_point` and `object_point`.
#include "common/geometry.glsl"

#include "common/sample_pixels.glsl"
uniform ivec2 low_resolution_size;

struct SurfacePoint { bool present; vec3 position; vec3 normal; float roughness; bool two_sided; };

#if defined(REAL) || defined(BOTH)
#include "common/surfaces.glsl"
uniform bool hidden_too;   // also grid texels whose real surfaces are hidden, because virtual surfaces reflect them

ivec2 real_pixel(ivec2 texel) {
    ivec2 pixel = texelFetch(sample_pixels, texel, 0).xy;
    return hidden_too && pixel.x < -1 ? -2 - pixel : pixel;
}

SurfacePoint real_point(ivec2 texel) {
    ivec2 pixel = real_pixel(texel);
    if (pixel.x < 0) return SurfacePoint(false, vec3(0.0), vec3(0.0, 0.0, 1.0), -1.0, false);
    vec4 normal = texelFetch(real_surface_normal, pixel, 0);
    float roughness = normal.w < 0.0 ? -1.0 : surfaces[int(normal.w)].surface.x;
    return SurfacePoint(true, texelFetch(real_surface_position, pixel, 0).xyz, normal.xyz, roughness, false);
}
#endif
#ifndef REAL
#include "common/shown_maps.glsl"

SurfacePoint object_point(ivec2 texel) {
    ivec2 pixel = texelFetch(sample_pixels, texel, 0).zw;
    if (pixel.x < 0) return SurfacePoint(false, vec3(0.0), vec3(0.0, 0.0, 1.0), -1.0, false);
    pixel = raster_texel(pixel);
    vec4 normal = texelFetch(virtual_raster_normal, pixel, 0);
    vec3 position = texelFetch(virtual_raster_position, pixel, 0).xyz;
    int material = int(normal.w);
    return SurfacePoint(true, position, normal.xyz, roughness_at(pixel, material), is_two_sided(material));
}
#endif

#ifndef BOTH
#ifdef REAL
SurfacePoint surface_point(ivec2 texel) { return real_point(texel); }
#else
SurfacePoint surface_point(ivec2 texel) { return object_point(texel); }
#endif
#endif
