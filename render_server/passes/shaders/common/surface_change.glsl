// How an object's surface goes on beside a pixel. Needs geometry.glsl and shown_maps.glsl.
#include "common/shown_normal.glsl"
uniform sampler2D object_coverage;
#pragma texels r16f object_coverage

// Change of position and normal from a pixel to the next along an axis; the smaller change of both sides, so that
// edges do not count.
struct Change { vec3 position; vec3 normal; };

Change change_along(ivec2 pixel, ivec2 axis, vec4 position, vec4 normal, bool of_coat) {
    Change least = Change(vec3(0.0), vec3(1e3));
    for (int side = -1; side <= 1; side += 2) {
        ivec2 beside = clamp(pixel + side * axis, ivec2(0), textureSize(object_coverage, 0) - 1), raster = raster_texel(beside);
        vec4 p = texelFetch(virtual_raster_position, raster, 0), n = shown_normal(raster, of_coat);
        bool shown = p.w > 0.0 && texelFetch(object_coverage, beside, 0).r > 0.0;
        bool next = shown && n.w == normal.w && distance(n, normal) < length(least.normal);
        if (next) least = Change(float(side) * (p - position).xyz, float(side) * (n - normal).xyz);
    }
    return length(least.normal) < 1.0 ? least : Change(vec3(0.0), vec3(0.0));
}
