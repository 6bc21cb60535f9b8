// Tiles of 8 x 8 texels or pixels, one for each invocation of a workgroup.
const uint REAL_TILE = 1u, OBJECT_TILE = 2u;

ivec2 place_in_tile(ivec2 tile) {
    return 8 * tile + ivec2(int(gl_LocalInvocationIndex) & 7, int(gl_LocalInvocationIndex) >> 3);
}
