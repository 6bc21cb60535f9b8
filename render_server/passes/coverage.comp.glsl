// One sample of every pixel taken over from a raster of the objects whose texel centres are moved by `offset`: which
// share of the pixel they cover, and the surface that stands for them, that of the sample nearest to the pixel's centre.
#include "passes/common/in_front.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
layout(binding = 0, rgba32f) uniform image2D position_out;
layout(binding = 1, rgba16f) uniform image2D normal_out;
layout(binding = 2, rg32f) writeonly uniform image2D uv_out;
layout(binding = 3, rgba8) writeonly uniform image2D tint_out;
layout(binding = 4, rgba16f) uniform image2D coverage;   // r: share in front of the real surface, g: behind it, b: g times its mean depth
layout(binding = 8) uniform sampler2D virtual_raster_uv;
layout(binding = 9) uniform sampler2D virtual_raster_tint;
layout(binding = 5, rgba32f) uniform image2D other;      // samples of another surface: the first one's place, w: their share
uniform vec4 camera_pinhole;   // fx, fy, cx, cy
uniform vec2 offset;           // pixels
uniform float weight;          // of a sample
uniform ivec4 rectangle;       // first pixel and size of the part of the picture that may show an object
uniform ivec4 raster_rectangle;  // the same of the raster: beyond it nothing was drawn

// Exactly one texel centre of the moved raster lies within half a pixel of any place.
ivec2 sampled_texel(ivec2 pixel) {
    vec2 place = vec2(pixel);
    if (lens_distortion) place = raster_pinhole.xy * texelFetch(picture_rays, pixel, 0).xy + raster_pinhole.zw;
    return ivec2(floor(place - offset + 0.5));
}

void take_over(ivec2 pixel, ivec2 raster, vec4 position) {
    imageStore(position_out, pixel, position);
    imageStore(normal_out, pixel, texelFetch(virtual_raster_normal, raster, 0));
    imageStore(uv_out, pixel, texelFetch(virtual_raster_uv, raster, 0));
    imageStore(tint_out, pixel, texelFetch(virtual_raster_tint, raster, 0));
}

// Whether a sample lies off the plane of the surface that stands for its pixel by more than the pixel spans there, or
// faces another way (37 degrees; a smooth surface turns less within a pixel).
bool is_another(ivec2 pixel, vec4 position, vec3 normal) {
    vec3 n = imageLoad(normal_out, pixel).xyz, apart = position.xyz - imageLoad(position_out, pixel).xyz;
    return abs(dot(apart, n)) > position.w / camera_pinhole.x || dot(normal, n) < 0.8;
}

void add_to_other(ivec2 pixel, vec4 position, vec3 normal) {
    if (!is_another(pixel, position, normal)) return;
    vec4 before = imageLoad(other, pixel);
    imageStore(other, pixel, vec4(before.w > 0.0 ? before.xyz : position.xyz, before.w + weight));
}

void main() {
    ivec2 inside = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(inside, rectangle.zw))) return;
    ivec2 pixel = rectangle.xy + inside;
    ivec2 raster = sampled_texel(pixel), in_raster = raster - raster_rectangle.xy;
    bool drawn = all(greaterThanEqual(in_raster, ivec2(0))) && all(lessThan(in_raster, raster_rectangle.zw));
    vec4 position = drawn ? texelFetch(virtual_raster_position, raster, 0) : vec4(0.0);
    vec4 sum = imageLoad(coverage, pixel);
    if (position.w > 0.0) {
        bool seen = in_front(pixel, position.w) > 0.0;
        // samples come in the order of their distance from the centre; one that shows stands before one that is hidden
        if (sum.r == 0.0 && (seen || sum.g == 0.0)) take_over(pixel, raster, position);
        if (sum.r > 0.0 && seen) add_to_other(pixel, position, texelFetch(virtual_raster_normal, raster, 0).xyz);
        sum += seen ? vec4(weight, 0.0, 0.0, 0.0) : weight * vec4(0.0, 1.0, position.w, 0.0);
    }
    imageStore(coverage, pixel, sum);
}
