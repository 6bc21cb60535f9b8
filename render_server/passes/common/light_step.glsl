// What goes on from a cell to its neighbour: a constant 4 x 4 matrix with six non-zeros a direction (METHOD 5).
uniform vec4 transfer;     // along the way: (1 <- 1, 1 <- along, along <- 1, along <- along)
uniform float sideways;    // across <- across

vec4 along_x(vec4 s, float way) {
    return vec4(transfer.x * s.x + way * transfer.y * s.y, way * transfer.z * s.x + transfer.w * s.y, sideways * s.zw);
}
vec4 along_y(vec4 s, float way) { return along_x(s.xzyw, way).xzyw; }
vec4 along_z(vec4 s, float way) { return along_x(s.xwzy, way).xwzy; }
