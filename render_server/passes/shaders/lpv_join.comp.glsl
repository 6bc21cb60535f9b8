// Puts the light of one of several volumes beside that of the others, in x, as lpv_light.glsl reads it.
layout(local_size_x = 16) in;
uniform sampler3D total;
#pragma texels rgba32f total
layout(rgba32f) writeonly uniform image3D joined;
uniform int cells;
uniform int first;   // x of the volume's first cell among all

void main() {
    ivec3 texel = ivec3(gl_GlobalInvocationID);
    if (any(greaterThanEqual(texel, ivec3(cells, cells, 3 * cells)))) return;
    imageStore(joined, texel + ivec3(first, 0, 0), texelFetch(total, texel, 0));
}
