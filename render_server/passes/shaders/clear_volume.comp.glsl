// Sets all texels of a 3-D texture to zero.
layout(local_size_x = 8, local_size_y = 8) in;
writeonly uniform image3D cleared;

void main() {
    ivec3 texel = ivec3(gl_GlobalInvocationID);
    if (all(lessThan(texel, imageSize(cleared)))) imageStore(cleared, texel, vec4(0.0));
}
