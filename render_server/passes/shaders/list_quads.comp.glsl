// Of each quad in the texels that show an object, lists the pixel that stands for it.
#include "common/work_list.glsl"
#define APPENDS_PIXELS
#include "common/shown_pixels.glsl"

layout(local_size_x = 64) in;
uniform sampler2D object_coverage;
uniform int scale;
#include "common/quads.glsl"

void main() {
    int grid_width = (textureSize(object_coverage, 0).x + scale - 1) / scale, edge = (scale + 1) / 2;
    uint quads = uint(edge * edge);
    for (uint i = first_item(); i < listed_count() * quads; i += items_apart()) {
        ivec2 first = pixel_in_block(texel_of_index(texels[i / quads], grid_width), 0, scale);
        ivec2 pixel = first_of_quad(first / 2 + ivec2(int(i % quads) % edge, int(i % quads) / edge));
        if (pixel.x >= 0) put_pixel(room_for_pixels(1u), pixel);
    }
}
