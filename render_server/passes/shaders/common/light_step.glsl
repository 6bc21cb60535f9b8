// Transfer from a cell to its neighbour: a constant 4 x 4 matrix with six non-zeros per direction (docs/method.md 5).
uniform vec4 transfer;     // along the axis: (1 <- 1, 1 <- along, along <- 1, along <- along)
uniform float sideways;    // across <- across

vec4 along_x(vec4 s, float direction) {
    float constant = transfer.x * s.x + direction * transfer.y * s.y;
    return vec4(constant, direction * transfer.z * s.x + transfer.w * s.y, sideways * s.zw);
}
vec4 along_y(vec4 s, float direction) { return along_x(s.xzyw, direction).xzyw; }
vec4 along_z(vec4 s, float direction) { return along_x(s.xwzy, direction).xwzy; }
