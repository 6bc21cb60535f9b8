// Where samples of a pixel show another surface of the objects than the shaded one, mixes in the light of that
// surface from the neighbour that shows it, by the samples' fraction.
#include "common/pixel_group.glsl"
layout(rgba16f) writeonly uniform image2D radiance_out;
uniform sampler2D radiance;
uniform sampler2D sample_coverage;
uniform sampler2D second_surface;
uniform sampler2D virtual_raster_position;
uniform sampler2D virtual_raster_normal;
#pragma texels rgba16f sample_coverage virtual_raster_normal
#pragma texels rgba32f virtual_raster_position
uniform ivec4 rectangle;       // first pixel and size of the part of the picture that may show an object

const float NEARNESS = 0.1;    // weight of the distance beside the distance from a neighbour's plane: it breaks ties

// Distance of a position from the surface of a neighbour, m; large where that shows no object.
float away(ivec2 at, vec3 place) {
    if (texelFetch(sample_coverage, at, 0).r == 0.0) return 1e9;
    vec3 apart = place - texelFetch(virtual_raster_position, at, 0).xyz;
    return abs(dot(apart, texelFetch(virtual_raster_normal, at, 0).xyz)) + NEARNESS * length(apart);
}

// That of the pixel if not wanted. (llvmpipe executes both sides of a branch, but no turn of a loop too many.)
vec3 radiance_of_other(ivec2 pixel, vec3 place, bool wanted) {
    ivec2 last = textureSize(radiance, 0) - 1, best = pixel;
    float least = away(pixel, place);
    int count = wanted ? 9 : 0;
    for (int i = 0; i < count; ++i) {
        ivec2 at = clamp(pixel + ivec2(i % 3, i / 3) - 1, ivec2(0), last);
        float d = away(at, place);
        if (d < least) { least = d; best = at; }
    }
    return texelFetch(radiance, best, 0).rgb;
}

void main() {
    ivec2 inside = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(inside, rectangle.zw))) return;
    ivec2 pixel = rectangle.xy + inside;
    float covered = texelFetch(sample_coverage, pixel, 0).r;
    if (covered == 0.0 && texelFetch(sample_coverage, pixel, 0).g == 0.0) return;
    vec4 second = texelFetch(second_surface, pixel, 0);
    vec3 own = texelFetch(radiance, pixel, 0).rgb;
    vec3 other = radiance_of_other(pixel, second.xyz, second.w > 0.0);
    if (second.w > 0.0) own = mix(own, other, second.w / covered);
    imageStore(radiance_out, pixel, vec4(own, 1.0));
}
