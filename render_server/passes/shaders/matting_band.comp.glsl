// Lists the pixels of objects whose matte is unknown for matting.comp.glsl.
#include "common/matting_band.glsl"
#define APPENDS_TEXELS
#include "common/work_list.glsl"

#include "common/pixel_group.glsl"
uniform ivec4 rectangle;   // that may show an object: first column and row, width and height
layout(rgba16f) writeonly uniform image2D estimate_out;   // nothing yet of matting.comp.glsl's

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, rectangle.zw))) return;
    pixel += rectangle.xy;
    imageStore(estimate_out, pixel, vec4(0.0));
    float z = depth_shown(pixel);
    if (z > 0.0 && near_front(pixel, z) && !inside_front(pixel, z))
        append_texel(pixel, textureSize(real_surface_position, 0).x);
}
