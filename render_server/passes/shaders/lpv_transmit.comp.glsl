// Covered faces -> fraction of light that enters each cell from its six neighbours, past real surfaces (JOINT: and
// virtual ones), packed in 8 bits each: neighbours at -x, +x, -y, +y, and at -z, +z.
#include "common/light_cells.glsl"

layout(local_size_x = 64) in;
layout(std430) readonly buffer RealCovered { int real_covered[]; };
layout(std430) readonly buffer VirtualCovered { int virtual_covered[]; };
layout(rg32ui) writeonly uniform uimage3D transmitted;
uniform int cells;

const float FIXED_POINT_STEPS = 1048576.0;   // voxel_store.glsl's

// Surfaces block from both sides: light inside a body does not leave it either.
float open_fraction(int one_side, int other_side) {
    return 1.0 - clamp(float(max(one_side, other_side)) / FIXED_POINT_STEPS, 0.0, 1.0);
}

float through(ivec3 cell, int axis, int upper) {
    cell[axis] += upper;
    if (!in_grid(cell, cells)) return 1.0;
    uint at = cell_index(cell, cells) * 6u + uint(2 * axis);
    float fraction = open_fraction(real_covered[at], real_covered[at + 1u]);
#ifdef JOINT
    fraction *= open_fraction(virtual_covered[at], virtual_covered[at + 1u]);
#endif
    return fraction;
}

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= uint(cells * cells * cells)) return;
    ivec3 cell = cell_of_index(i, cells);
    vec4 xy = vec4(through(cell, 0, 0), through(cell, 0, 1), through(cell, 1, 0), through(cell, 1, 1));
    vec4 z = vec4(through(cell, 2, 0), through(cell, 2, 1), 0.0, 0.0);
    imageStore(transmitted, cell, uvec4(packUnorm4x8(xy), packUnorm4x8(z), 0u, 0u));
}
