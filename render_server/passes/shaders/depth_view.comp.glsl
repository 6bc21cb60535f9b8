// Writes a camera's inverse depth into its layer of those of all cameras: negative where no plane is fitted to it.
#define FITS_DEPTH
#include "common/fitted_normal.glsl"

#include "common/pixel_group.glsl"
uniform int layer;
layout(r32f) writeonly uniform image2DArray inverse_out;

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, textureSize(inverse_depth, 0)))) return;
    float w = texelFetch(inverse_depth, pixel, 0).r;
    imageStore(inverse_out, ivec3(pixel, layer), vec4(slope_at(pixel).z > 0.5 ? w : -w));
}
