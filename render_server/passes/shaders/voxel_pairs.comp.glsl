// Lists the voxels that each triangle may meet: those of its box that its plane cuts. Clipping takes far longer, so it gets a
// thread for each pair, however many voxels a triangle meets.
#include "common/volume.glsl"
#define PAIRS_ACCESS
#include "common/voxel_pairs.glsl"

layout(local_size_x = 64) in;
uniform int triangle_count;
uniform int filled_volume;

const float SLACK = 1e-3;   // relative, and in voxels: more than rounding

void append(uint triangle, ivec3 voxel) {
    uint index = atomicAdd(pair_count, 1u);
    if (index < uint(pairs.length())) pairs[index] = pair_of(triangle, voxel);
}

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= uint(triangle_count)) return;
    work_in_volume(filled_volume);
    Triangle t = triangles[i];
    vec3 a = volume_coordinate(corner_position(t.corners[0]));
    vec3 b = volume_coordinate(corner_position(t.corners[1]));
    vec3 c = volume_coordinate(corner_position(t.corners[2]));
    vec3 n = cross(b - a, c - a);
    if (dot(n, n) == 0.0) return;
    ivec3 low = ivec3(floor(min(a, min(b, c)))), high = ivec3(floor(max(a, max(b, c))));
    ivec3 first = max(low, ivec3(0)), last = min(high, ivec3(volume_size - 1)), extent = last - first + 1;
    if (any(lessThan(extent, ivec3(1)))) return;   // rounding may put it outside
    float half_width = dot(abs(n), vec3(0.5 + SLACK)) * (1.0 + SLACK);
    bool single = low == high;
    for (int k = 0; k < extent.x * extent.y * extent.z; ++k) {
        ivec3 voxel = first + ivec3(k % extent.x, k / extent.x % extent.y, k / (extent.x * extent.y));
        if (single || abs(dot(n, vec3(voxel) + 0.5 - a)) <= half_width) append(i, voxel);
    }
}
