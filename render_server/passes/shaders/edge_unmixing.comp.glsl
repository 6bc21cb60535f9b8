// Unmixes the pixels that object_coverage listed.
#include "common/unmixing.glsl"
#include "common/work_list.glsl"

layout(local_size_x = 64) in;

void main() {
    int width = textureSize(real_surface_position, 0).x;
    uint i = first_item();
    if (i < listed_count()) do unmix(texel_of_index(texels[i], width));
    while ((i += items_apart()) < listed_count());
}
