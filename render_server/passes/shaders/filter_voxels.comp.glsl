// Filters levels of the six one-sided mipmaps (docs/method.md 4.4): two cells along k composited front to back, mean of
// the four across. Coverage of the two cells adds up to at most 1 (see trace_cones: pieces of one surface do not occlude
// each other). With FUSED, all levels in one dispatch (common/mipmap_tiles.glsl); nothing is read below cells that hold nothing,
// which are most. RESOLVES: it also computes level 0 from the sums (resolved_voxels.glsl). Software renderers compute such cells as
// well: with LISTED, they walk the voxels that a set touched, to the cells of level 1 around them, where nearly all of the work is.
#include "common/volume.glsl"

#if defined(LISTED) || defined(RESOLVES)
#define GRID_ACCESS readonly
#ifdef LISTED
#define TOUCHED_ACCESS readonly
#else
#define SUMS_ACCESS readonly
#endif
#include "common/voxel_store.glsl"
#endif

#ifdef LISTED
#include "common/walk.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) uniform image3D mipmap;
#else
#ifdef FUSED
#include "common/occupancy.glsl"
#ifdef RESOLVES
#include "common/resolved_voxels.glsl"
#endif

layout(rgba16f) coherent uniform image3D mipmap;
#else
layout(local_size_x = 4, local_size_y = 4, local_size_z = 4) in;
layout(rgba16f) uniform image3D mipmap;
uniform int first_level;   // to write; >= 1
#endif
#endif

vec4 fetch(int level, ivec3 cell, int k) { return imageLoad(mipmap, level_base(level - 1, k) + cell); }

vec4 front_to_back(vec4 front, vec4 back) {
    float room = 1.0 - front.a;
    return front + back * (back.a > room ? room / back.a : 1.0);
}

#ifdef FUSED
// Whether a cell may hold anything: it does not unless all of its corners say so.
bool may_hold(int level, ivec3 cell) {
    return is_occupied(volume, volume_size, level, cell) && is_occupied(volume, volume_size, level, cell + 1);
}
#else
bool may_hold(int level, ivec3 cell) { return true; }
#endif

vec4 filtered(int level, ivec3 cell, int k) {
    int along = k >> 1, u = (along + 1) % 3, v = (along + 2) % 3;
    ivec3 step_along = ivec3(0), step_u = ivec3(0), step_v = ivec3(0);
    step_along[along] = 1; step_u[u] = 1; step_v[v] = 1;
    ivec3 front = 2 * cell + ((k & 1) == 0 ? ivec3(0) : step_along);
    ivec3 back = 2 * cell + ((k & 1) == 0 ? step_along : ivec3(0));
    vec4 sum = vec4(0.0);
    for (int j = 0; j < 4; ++j) {
        ivec3 across = (j & 1) * step_u + (j >> 1) * step_v;
        sum += front_to_back(fetch(level, front + across, k), fetch(level, back + across, k));
    }
    return 0.25 * sum;
}

#ifdef RESOLVES
// Writes a voxel's texel, if a set touched it.
void resolve(ivec3 v, int k) {
    uint voxel = voxel_index(v + ivec3(0, 0, volume * volume_size), volume_size), slot = grid[voxel];
    ivec3 texel = level_base(0, k) + v;
#ifdef RHO
    uint other = virtual_grid[voxel];
    if (slot != 0u) imageStore(mipmap, texel, joint_texel(int(slot - 1u), other, k));
    else if (other != 0u) imageStore(mipmap, texel, virtual_texel(int(other - 1u), k));
#else
    if (slot != 0u) imageStore(mipmap, texel, real_texel(int(slot - 1u), k));
#endif
}

void resolve_cell(ivec3 cell, int k) {
    for (int j = 0; j < 8; ++j) resolve(2 * cell + ivec3(j & 1, j >> 1 & 1, j >> 2), k);
}
#else
void resolve_cell(ivec3 cell, int k) {}
#endif

void write_cell(int level, ivec3 cell, int k) {
    bool holds = may_hold(level, cell);
    if (level == 1 && holds) resolve_cell(cell, k);
    vec4 sum = holds ? filtered(level, cell, k) : vec4(0.0);
    imageStore(mipmap, level_base(level, k) + cell, sum);
}

#ifdef LISTED
// Whether no touched voxel precedes this one in its cell.
bool stands_for_cell(uint i) {
    int n = volume_size;
    ivec3 v = voxel_of_index(touched[i], n), inner = v & 1;
    int first = int(voxel_index(v - inner, n)), own = inner.x + 2 * inner.y + 4 * inner.z;
    bool stands = true;
    for (int at = 0; at < 7; ++at) {
        bool before = grid[first + (at & 1) + n * ((at >> 1 & 1) + n * (at >> 2))] != 0u;
        stands = stands && !(before && at < own);
    }
    return stands;
}

// Lanes of a processor look for their next cells in a loop of their own, and filter together.
bool find_cell(inout uint i) {
    bool found = false;
    if (i < slot_count) do {
        found = stands_for_cell(i);
        if (!found) i += items_apart();
    } while (i < slot_count && !found);
    return found;
}

void main() {
    uint i = first_item();
    if (find_cell(i)) do {
        ivec3 cell = enter_volume_of(touched[i], volume_size) >> 1;
        for (int k = 0; k < DIRECTIONS; ++k) write_cell(1, cell, k);
        i += items_apart();
    } while (find_cell(i));
}
#else
#ifdef FUSED
#include "common/mipmap_tiles.glsl"
#else
void main() {
    int cells = volume_size >> first_level;
    ivec3 id = ivec3(gl_GlobalInvocationID);
    int slab = id.z / cells;
    if (id.x >= cells || id.y >= cells || slab >= volume_count * DIRECTIONS) return;
    work_in_volume(slab / DIRECTIONS);
    write_cell(first_level, ivec3(id.xy, id.z - slab * cells), slab % DIRECTIONS);
}
#endif
#endif
