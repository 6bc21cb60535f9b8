// Triangles of a mesh as the voxeliser takes them: themselves, or their backs.
struct Corner { vec3 place; vec2 uv; vec4 tint; };   // tint: colour, opacity
struct Piece { Corner a; Corner b; Corner c; };   // of a triangle, or all of it

layout(std430) readonly buffer Vertices { float vertices[]; };   // VERTEX_FLOATS each (scene/gpu_mesh.py)
layout(std430) readonly buffer Indices { uint indices[]; };      // three a triangle

const uint VERTEX_FLOATS = 12u;
const uint NOT_CHOSEN = 0xffffffffu;   // in place of a triangle's number in a list of those that count

vec3 vertex_vector(uint i) { return vec3(vertices[i], vertices[i + 1u], vertices[i + 2u]); }

Corner corner_at(uint vertex) {
    uint i = vertex * VERTEX_FLOATS;
    // A fraction beside the material's number (scene/gpu_mesh.py), 0 where vertices are opaque.
    float opacity = 1.0 - 2.0 * fract(vertices[i + 11u]);
    return Corner(vertex_vector(i), vec2(vertices[i + 6u], vertices[i + 7u]), vec4(vertex_vector(i + 8u), opacity));
}

int material_of(uint triangle) { return int(vertices[indices[3u * triangle] * VERTEX_FLOATS + 11u]); }

// Rounded like scene/depth_mesh.py: pictures do not depend on who computed it.
float length_of(vec3 v) {
    precise float squares = v.x * v.x + v.y * v.y + v.z * v.z;
    return sqrt(squares);
}

vec3 shift_of(vec3 a, vec3 b, vec3 c, float behind) {
    precise vec3 one = b - a, other = c - a;
    precise vec3 across = one.yzx * other.zxy - one.zxy * other.yzx;
    precise vec3 normal = across / max(length_of(across), 1.17549435e-38);
    precise vec3 shift = behind * normal;
    return shift;
}

// `behind`, m: not 0 for backs, which lie so far behind their triangles and face the other way.
Piece triangle_at(uint triangle, float behind) {
    Corner a = corner_at(indices[3u * triangle]), b = corner_at(indices[3u * triangle + 1u]);
    Corner c = corner_at(indices[3u * triangle + 2u]);
    if (behind == 0.0) return Piece(a, b, c);
    precise vec3 shift = shift_of(a.place, b.place, c.place, behind);
    a.place -= shift;
    b.place -= shift;
    c.place -= shift;
    return Piece(c, b, a);
}
