// A mesh's triangles for the voxeliser, the pieces that long ones are cut into, and the pairs of a piece and a voxel that it
// may meet. Needs PAIRS_ACCESS: `readonly`, or empty.
//
// A piece is a triangle's number and a path: 1, then a bit for each cut, which half it is. A cut joins the middle of the
// longest edge with the corner opposite.
struct Corner { vec3 place; vec2 uv; vec3 tint; };
struct Piece { Corner a; Corner b; Corner c; };
struct Pair { uint triangle; uint path; uint voxel; };   // packed

layout(std430) readonly buffer Vertices { float vertices[]; };   // VERTEX_FLOATS each (scene/triangle_mesh.py)
layout(std430) readonly buffer Indices { uint indices[]; };      // three a triangle
layout(std430) PAIRS_ACCESS buffer Pairs {
    uint pair_count;   // also of those that found no room, as all of these
    uint long_count;
    uint refused_count;
    uint pairs_pad;
    Pair pairs[];
};
uniform float behind;   // m: not 0 for backs, which lie so far behind their triangles and face the other way

const uint VERTEX_FLOATS = 12u, WHOLE = 1u;

uint voxel_bits(ivec3 voxel) { return uint(voxel.x | voxel.y << 10 | voxel.z << 20); }

ivec3 voxel_of_bits(uint bits) { return ivec3(bits & 1023u, bits >> 10 & 1023u, bits >> 20); }

vec3 vertex_vector(uint i) { return vec3(vertices[i], vertices[i + 1u], vertices[i + 2u]); }

Corner corner_at(uint vertex) {
    uint i = vertex * VERTEX_FLOATS;
    return Corner(vertex_vector(i), vec2(vertices[i + 6u], vertices[i + 7u]), vertex_vector(i + 8u));
}

int material_of(uint triangle) { return int(vertices[indices[3u * triangle] * VERTEX_FLOATS + 11u]); }

// Rounded like scene/depth_mesh.py: pictures do not depend on who computed it.
float length_of(vec3 v) {
    precise float squares = v.x * v.x + v.y * v.y + v.z * v.z;
    return sqrt(squares);
}

vec3 behind_of(vec3 a, vec3 b, vec3 c) {
    precise vec3 one = b - a, other = c - a;
    precise vec3 across = one.yzx * other.zxy - one.zxy * other.yzx;
    precise vec3 normal = across / max(length_of(across), 1.17549435e-38);
    precise vec3 shift = behind * normal;
    return shift;
}

Piece triangle_at(uint triangle) {
    Corner a = corner_at(indices[3u * triangle]), b = corner_at(indices[3u * triangle + 1u]);
    Corner c = corner_at(indices[3u * triangle + 2u]);
    if (behind == 0.0) return Piece(a, b, c);
    precise vec3 shift = behind_of(a.place, b.place, c.place);
    a.place -= shift;
    b.place -= shift;
    c.place -= shift;
    return Piece(c, b, a);
}

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
    Piece p = triangle_at(triangle);
    for (int bit = findMSB(path) - 1; bit >= 0; --bit) p = half_of(p, (path >> bit & 1u) != 0u);
    return p;
}
