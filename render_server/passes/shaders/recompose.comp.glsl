// A new picture in the light of an earlier one: by the ratio that composite.comp.glsl kept of every pixel near a change.
#include "common/camera_codes.glsl"
#include "common/camera_response.glsl"
#include "common/work_list.glsl"

layout(local_size_x = 64) in;
layout(rgba8ui) writeonly uniform uimage2D code_out;
layout(rgba32f) readonly uniform image2D relit_ratio;
#include "common/interior_edges.glsl"
uniform sampler2D object_coverage;
uniform sampler2D edge_correction;   // common/edge_sides.glsl
uniform isampler2D sample_pixels;
#pragma texels r16f object_coverage
#pragma texels rgba16f edge_correction
uniform int scale;
uniform float exposure_scale;

void recompose(ivec2 pixel) {
    uvec4 code = uvec4(texelFetch(picture, pixel, 0).rgb, 255u);
    vec4 ratio = imageLoad(relit_ratio, pixel);
    vec3 b = max(radiance_of(code.rgb) + texelFetch(edge_correction, pixel, 0).rgb, vec3(0.0));
    float shown = texelFetch(object_coverage, pixel, 0).r;
    vec3 result = mix(b * ratio.rgb, objects_radiance(pixel), shown);
    if (ratio.a > 0.0) code.rgb = encode(result * exposure_scale);
    imageStore(code_out, pixel, code);
}

void main() {
    ivec2 size = textureSize(picture, 0), grid = textureSize(sample_pixels, 0);
    int block = scale * scale;
    uint count = listed_count() * uint(block);
    for (uint i = first_item(); i < count; i += items_apart()) {
        int number = quotient(int(i), block);
        ivec2 pixel = pixel_in_block(texel_of_index(texels[number], grid.x), int(i) - number * block, scale);
        if (all(lessThan(pixel, size))) recompose(pixel);
    }
}
