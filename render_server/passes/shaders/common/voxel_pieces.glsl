// The pieces that a mesh's long triangles are cut into, and the pairs of a piece and a voxel that it may meet. Needs
// PAIRS_ACCESS: `readonly`, or empty; and volume.glsl.
//
// Parts of a mesh that fill volumes together are fillings: a part in one volume each. A piece is a triangle in a filling and a
// path: 1, then a bit for each cut, which half it is. A cut joins the middle of the longest edge with the corner opposite.
#include "common/solid_mesh.glsl"

const int MOST_FILLINGS = 8;
uniform ivec4 fillings[MOST_FILLINGS];   // first triangle, how many, where their list begins in Chosen or -1, volume
uniform float behind[MOST_FILLINGS];     // m (solid_mesh.glsl)

struct Pair { uint triangle; uint path; uint voxel; };   // packed

layout(std430) PAIRS_ACCESS buffer Pairs {
    uint pair_count;   // also of those that found no room, as all of these
    uint long_count;
    uint refused_count;
    uint pairs_pad;
    Pair pairs[];
};

const uint WHOLE = 1u;
const int FILLING_BIT = 29;   // of a triangle: the first of its filling's

uint in_filling(int filling, uint triangle) { return triangle | uint(filling) << FILLING_BIT; }

void enter_filling_of(uint triangle) { work_in_volume(fillings[triangle >> FILLING_BIT].w); }

uint number_of(uint triangle) { return triangle & (1u << FILLING_BIT) - 1u; }

uint voxel_bits(ivec3 voxel) { return uint(voxel.x | voxel.y << 10 | voxel.z << 20); }

ivec3 voxel_of_bits(uint bits) { return ivec3(bits & 1023u, bits >> 10 & 1023u, bits >> 20); }

vec3 edge_lengths(Piece p) {
    return vec3(length_of(p.b.place - p.a.place), length_of(p.c.place - p.b.place), length_of(p.a.place - p.c.place));
}

float longest_edge(Piece p) {
    vec3 edges = edge_lengths(p);
    return max(edges.x, max(edges.y, edges.z));
}

Piece half_of(Piece p, bool second) {
    vec3 edges = edge_lengths(p);
    if (edges.x < edges.y || edges.x < edges.z) p = edges.y >= edges.z ? Piece(p.b, p.c, p.a) : Piece(p.c, p.a, p.b);
    Corner middle = Corner(0.5 * (p.a.place + p.b.place), 0.5 * (p.a.uv + p.b.uv), 0.5 * (p.a.tint + p.b.tint));
    if (second) p.a = middle;
    else p.b = middle;
    return p;
}

Piece piece_of(uint triangle, uint path) {
    Piece p = triangle_at(number_of(triangle), behind[triangle >> FILLING_BIT]);
    for (int bit = findMSB(path) - 1; bit >= 0; --bit) p = half_of(p, (path >> bit & 1u) != 0u);
    return p;
}
