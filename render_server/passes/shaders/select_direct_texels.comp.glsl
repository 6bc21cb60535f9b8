// Lists the texels of the reduced grid in which objects may change the direct light of a pixel.
#include "common/light_reach.glsl"
#define APPENDS_TEXELS
#include "common/work_list.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
uniform ivec2 low_resolution_size;
uniform int scale;

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy), size = textureSize(real_surface_position, 0);
    if (any(greaterThanEqual(texel, low_resolution_size))) return;
    bool reached = false;
    for (int i = 0; i < scale * scale && !reached; ++i) {
        ivec2 pixel = min(pixel_in_block(texel, i, scale), size - 1);
        vec4 position = texelFetch(real_surface_position, pixel, 0);
        reached = light_may_change(pixel, position, texelFetch(real_surface_normal, pixel, 0).xyz);
    }
    if (reached) append_texel(texel, low_resolution_size.x);
}
