// Surfels of a block of 2^3 voxels whose normals have the same main axis form a group: one gathering of light serves
// all. Needs volume.glsl and voxel_store.glsl; blocks are declared as there.
#ifdef GROUP_SUMS_ACCESS
layout(std430) GROUP_SUMS_ACCESS buffer GroupSums { int group_sums[]; };       // GROUP_SUMS a slot
#endif
#ifdef GROUP_LIGHT_ACCESS
layout(std430) GROUP_LIGHT_ACCESS buffer GroupLight { vec4 group_light[]; };   // a slot: irradiance of mu and
// near_coverage (diffuse_cones.glsl), irradiance of rho
#endif

const int GROUP_AREA = 0, GROUP_UNSEEN = 1, GROUP_NORMAL = 2, GROUP_PLACE = 5;   // all weighted by area / h^2
const int GROUP_IRRADIANCE = 8, GROUP_RADIANCE = 9;   // luminance of mu, of all light
const int GROUP_TWO_SIDED = 10;   // surfels
const int GROUP_SUMS = 11;
const float LIGHT_FIXED_POINT = 1024.0;   // of these two: sums up to 2e6
const vec3 LUMINANCE = vec3(0.2126, 0.7152, 0.0722);

int main_axis(vec3 n) {
    vec3 a = abs(n);
    int axis = a.x >= a.y && a.x >= a.z ? 0 : (a.y >= a.z ? 1 : 2);
    return 2 * axis + (n[axis] < 0.0 ? 1 : 0);
}

uint group_entry(uint voxel, vec3 n) {
    ivec3 block = voxel_of_index(voxel, volume_size) / 2;
    return voxel_index(block, volume_size / 2) * 6u + uint(main_axis(n));
}

// Low corner (voxels) of the block of an entry of the grid, in the volume that it enters.
vec3 block_corner(uint entry) { return vec3(2 * enter_volume_of(entry / 6u, volume_size / 2)); }

#ifdef GROUP_ENTRIES_ACCESS
layout(std430) GROUP_ENTRIES_ACCESS buffer GroupEntries { uint group_count; uint group_entries[]; };

uint groups_held() { return min(group_count, uint(group_entries.length())); }
#elif defined(GROUP_LIGHT_ACCESS)
uint groups_held() { return uint(group_light.length()) / 2u; }   // as many as there is room for: no less than there are
#endif

#ifdef GROUP_GRID_ACCESS
layout(std430) GROUP_GRID_ACCESS buffer GroupGrid { uint group_grid[]; };      // slot + 1 of each block and main axis

// Slot of the group, -1 where there was no room for it. Needs GROUP_ENTRIES_ACCESS.
int group_slot(uint entry) {
    uint held = group_grid[entry];
    return held == 0u || held > groups_held() ? -1 : int(held) - 1;
}
#endif
