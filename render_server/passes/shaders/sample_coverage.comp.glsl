// One sample of every pixel from a raster of the objects whose texel centres are shifted by `offset`: the fraction of
// the pixel that they cover, and the surface that represents them, that of the sample nearest to the pixel's centre.
#include "common/in_front.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
layout(rgba32f) uniform image2D position_out;
layout(rgba16f) uniform image2D normal_out;
layout(rg32f) writeonly uniform image2D uv_out;
layout(rgba8) writeonly uniform image2D tint_out;
// r: fraction in front of the real surface, g: behind it, b: g times its mean depth
layout(rgba16f) uniform image2D sample_coverage;
uniform sampler2D virtual_raster_uv;
uniform sampler2D virtual_raster_tint;
// samples of another surface: the first one's position, w: their fraction
layout(rgba32f) uniform image2D second_surface;
#include "common/camera.glsl"
uniform vec2 offset;           // pixels
uniform float weight;          // of a sample
uniform ivec4 rectangle;       // first pixel and size of the part of the picture that may show an object
uniform ivec4 raster_rectangle;  // the same of the raster: nothing was drawn beyond it

// Exactly one texel centre of the shifted raster is within half a pixel of any position.
ivec2 sampled_texel(ivec2 pixel) {
    vec2 place = vec2(pixel);
    if (lens_distortion) place = raster_pinhole.xy * texelFetch(picture_rays, pixel, 0).xy + raster_pinhole.zw;
    return ivec2(floor(place - offset + 0.5));
}

void copy_surface(ivec2 pixel, ivec2 raster, vec4 position) {
    imageStore(position_out, pixel, position);
    imageStore(normal_out, pixel, texelFetch(virtual_raster_normal, raster, 0));
    imageStore(uv_out, pixel, texelFetch(virtual_raster_uv, raster, 0));
    imageStore(tint_out, pixel, texelFetch(virtual_raster_tint, raster, 0));
}

// Whether a sample is off the plane of the surface that represents its pixel by more than the pixel spans there, or
// faces another way (37 degrees; a smooth surface bends less within a pixel).
bool is_another(ivec2 pixel, vec4 position, vec3 normal) {
    vec3 n = imageLoad(normal_out, pixel).xyz, apart = position.xyz - imageLoad(position_out, pixel).xyz;
    return abs(dot(apart, n)) > position.w / camera_pinhole.x || dot(normal, n) < 0.8;
}

void add_to_second(ivec2 pixel, vec4 position, vec3 normal) {
    if (!is_another(pixel, position, normal)) return;
    vec4 before = imageLoad(second_surface, pixel);
    imageStore(second_surface, pixel, vec4(before.w > 0.0 ? before.xyz : position.xyz, before.w + weight));
}

void main() {
    ivec2 inside = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(inside, rectangle.zw))) return;
    ivec2 pixel = rectangle.xy + inside;
    ivec2 raster = sampled_texel(pixel), in_raster = raster - raster_rectangle.xy;
    bool drawn = all(greaterThanEqual(in_raster, ivec2(0))) && all(lessThan(in_raster, raster_rectangle.zw));
    vec4 position = drawn ? texelFetch(virtual_raster_position, raster, 0) : vec4(0.0);
    vec4 sum = imageLoad(sample_coverage, pixel);
    if (position.w > 0.0) {
        bool seen = in_front(pixel, position.w) > 0.0;
        // samples come in the order of their distance from the centre; a visible one takes precedence over a hidden
        // one
        if (sum.r == 0.0 && (seen || sum.g == 0.0)) copy_surface(pixel, raster, position);
        if (sum.r > 0.0 && seen) add_to_second(pixel, position, texelFetch(virtual_raster_normal, raster, 0).xyz);
        sum += seen ? vec4(weight, 0.0, 0.0, 0.0) : weight * vec4(0.0, 1.0, position.w, 0.0);
    }
    imageStore(sample_coverage, pixel, sum);
}
