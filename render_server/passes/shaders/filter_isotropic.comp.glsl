// Filters levels of the isotropic mipmaps of V_delta and V_rho: means of eight cells ([P1] 3.2). With FUSED, all of them in one
// dispatch (common/mipmap_tiles.glsl); else one, where cells of further volumes follow in z.
#include "common/volume.glsl"

#ifdef FUSED
layout(rgba16f) coherent uniform image3D delta;
layout(rgba16f) coherent uniform image3D rho;
#else
layout(local_size_x = 4, local_size_y = 4, local_size_z = 4) in;
layout(rgba16f) uniform image3D delta;
layout(rgba16f) uniform image3D rho;
uniform int first_level;   // the level to write; >= 1
#endif

void write_cell(int level, ivec3 cell, int k) {
    ivec3 finer = level_base(level - 1, k) + 2 * cell;
    vec4 sum_delta = vec4(0.0), sum_rho = vec4(0.0);
    for (int j = 0; j < 8; ++j) {
        ivec3 at = finer + ivec3(j & 1, (j >> 1) & 1, j >> 2);
        sum_delta += imageLoad(delta, at);
        sum_rho += imageLoad(rho, at);
    }
    ivec3 to = level_base(level, k) + cell;
    imageStore(delta, to, 0.125 * sum_delta);
    imageStore(rho, to, 0.125 * sum_rho);
}

#ifdef FUSED
#include "common/mipmap_tiles.glsl"
#else
void main() {
    ivec3 cell = ivec3(gl_GlobalInvocationID);
    int cells = volume_size >> first_level;
    if (any(greaterThanEqual(cell, ivec3(cells, cells, volume_count * cells)))) return;
    work_in_volume(cell.z / cells);
    cell.z -= volume * cells;
    write_cell(first_level, cell, 0);
}
#endif
