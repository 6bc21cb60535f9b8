// Lists the voxels that each piece of a triangle may meet: those of its box that its plane cuts. Clipping takes far longer, so
// it gets a thread for each pair, however many voxels a triangle meets. Triangles longer than `longest_voxels` are listed
// first and cut then (LONG), some levels each, so that no thread has much more to do than others. Fillings lie in y.
#include "common/volume.glsl"
#include "common/walk.glsl"
#define PAIRS_ACCESS
#include "common/voxel_pieces.glsl"

layout(local_size_x = 64) in;
uniform float longest_voxels;   // longer edges are cut

const float SLACK = 1e-3;     // relative, and in voxels: more than rounding
const int LAST_LEVELS = 5;    // of cuts that the thread of a long piece makes
const int MOST_LEVELS = 30;   // bits of a path

// Triangle and path of a piece to be cut.
#ifdef LONG
layout(std430) readonly buffer LongPieces { uvec2 long_pieces[]; };
#else
layout(std430) buffer LongPieces { uvec2 long_pieces[]; };
layout(std430) readonly buffer Chosen { uint chosen[]; };   // numbers from a filling's first triangle on, or NOT_CHOSEN
#endif

float longest_kept() { return longest_voxels * voxel_edge; }

bool reaches_volume(Piece p) {
    vec3 a = volume_coordinate(p.a.place), b = volume_coordinate(p.b.place), c = volume_coordinate(p.c.place);
    vec3 low = min(a, min(b, c)), high = max(a, max(b, c));
    return all(greaterThan(high, vec3(-SLACK))) && all(lessThan(low, vec3(float(volume_size) + SLACK)));
}

void list_pair(uint triangle, uint path, ivec3 voxel) {
    uint index = atomicAdd(pair_count, 1u);
    if (index < uint(pairs.length())) pairs[index] = Pair(triangle, path, voxel_bits(voxel));
}

void list_pairs(uint triangle, uint path, Piece p) {
    vec3 a = volume_coordinate(p.a.place), b = volume_coordinate(p.b.place), c = volume_coordinate(p.c.place);
    vec3 n = cross(b - a, c - a);
    if (dot(n, n) == 0.0) return;
    ivec3 low = ivec3(floor(min(a, min(b, c)))), high = ivec3(floor(max(a, max(b, c))));
    ivec3 first = max(low, ivec3(0)), last = min(high, ivec3(volume_size - 1)), extent = last - first + 1;
    if (any(lessThan(extent, ivec3(1)))) return;
    float half_width = dot(abs(n), vec3(0.5 + SLACK)) * (1.0 + SLACK);
    bool single = low == high;
    for (int k = 0; k < extent.x * extent.y * extent.z; ++k) {
        ivec3 voxel = first + ivec3(k % extent.x, k / extent.x % extent.y, k / (extent.x * extent.y));
        if (single || abs(dot(n, vec3(voxel) + 0.5 - a)) <= half_width) list_pair(triangle, path, voxel);
    }
}

// What is to be done with a piece that reaches the volume and is not cut any further.
void list_piece(uint triangle, uint path, Piece p, bool is_long) {
#ifdef LONG
    if (is_long) atomicAdd(refused_count, 1u);
    else list_pairs(triangle, path, p);
#else
    if (!is_long) {
        list_pairs(triangle, path, p);
        return;
    }
    uint index = atomicAdd(long_count, 1u);
    if (index < uint(long_pieces.length())) long_pieces[index] = uvec2(triangle, path);
#endif
}

// Cuts a piece until its parts are short or that many cuts deep. What does not reach the volume is left out.
void cut_piece(uint triangle, uint root, int levels) {
    uint path = root;
    int top = findMSB(root);
    bool is_done = false;
    while (!is_done) {
        Piece p = piece_of(triangle, path);
        bool reaches = reaches_volume(p), is_long = longest_edge(p) > longest_kept();
        if (reaches && is_long && findMSB(path) < levels) {
            path <<= 1;
            continue;
        }
        if (reaches) list_piece(triangle, path, p, is_long);
        ++path;
        path >>= findLSB(path);   // past what lies below it
        is_done = findMSB(path) <= top;
    }
}

#ifdef LONG
void main() {
    uint count = min(long_count, uint(long_pieces.length()));
    for (uint i = first_item(); i < count; i += items_apart()) {
        enter_filling_of(long_pieces[i].x);
        cut_piece(long_pieces[i].x, long_pieces[i].y, MOST_LEVELS);
    }
}
#else
void main() {
    int i = int(gl_GlobalInvocationID.x), filling = int(gl_WorkGroupID.y);
    ivec4 own = fillings[filling];
    if (i >= own.y) return;
    uint number = own.z < 0 ? uint(i) : chosen[own.z + i];
    if (number == NOT_CHOSEN) return;
    uint triangle = in_filling(filling, uint(own.x) + number);
    enter_filling_of(triangle);
    Piece p = piece_of(triangle, WHOLE);
    if (!reaches_volume(p)) return;
    float length_ratio = longest_edge(p) / longest_kept();
    // n cuts leave no edge longer than sqrt(3) 2^(-n/2) of the longest (Stynes 1980).
    int levels = int(ceil(2.0 * log2(max(length_ratio, 1.0)) + 1.585));
    cut_piece(triangle, WHOLE, clamp(levels - LAST_LEVELS, 0, MOST_LEVELS));
}
#endif
