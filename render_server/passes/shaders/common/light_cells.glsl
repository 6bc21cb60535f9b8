// Cells of a light propagation volume: intensity as spherical harmonics of 4 coefficients (1, x, y, z; grid axes are
// world axes), per cell edge squared, for each colour channel: textures with the cells of one channel above those of
// another (software renderers read texels of a vector at once, and buffers one by one). Sums of injected light are
// fixed-point integers, so that they do not depend on the order of threads. `volume_size`: cells per edge,
// `voxel_edge`: a cell's edge, m.
#include "common/quotient.glsl"
const vec2 LOBE = vec2(0.886226925, 1.023326708);        // clamped cosine: sqrt(pi) / 2, sqrt(pi / 3)
const float INJECTED_STEPS = 1048576.0;                   // 2^20 per unit: 1e-6 resolution, sums up to 2047
const int INJECTED_SUMS = 12;                             // per cell: 4 coefficients x 3 channels

vec4 lobe(vec3 axis) { return vec4(LOBE.x, LOBE.y * axis); }

ivec3 in_channel(ivec3 cell, int channel, int n) { return cell + ivec3(0, 0, channel * n); }

uint cell_index(ivec3 cell, int n) { return uint((cell.z * n + cell.y) * n + cell.x); }

ivec3 cell_of_index(uint i, int n) {
    int row = quotient(int(i), n), layer = quotient(row, n);
    return ivec3(int(i) - row * n, row - layer * n, layer);
}

bool in_grid(ivec3 cell, int n) { return all(greaterThanEqual(cell, ivec3(0))) && all(lessThan(cell, ivec3(n))); }
