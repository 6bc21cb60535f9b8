// Closest hit of a ray on the objects' triangles, and the surface there. The hierarchy (render_server/scene/bvh.py)
// is in depth-first order with skips, so that no stack is needed. Backs that the camera does not see, rays do not meet either, unless
// they are a light's (MEETS_BACKS); of transparent bodies they meet both sides.
#include "common/materials.glsl"
#pragma switch CUTOUTS
#ifndef MEETS_BACKS
#pragma switch HIDES_BACKS
#endif

struct Node { vec3 low; int leaf; vec3 high; int skip; };   // leaf: first triangle << 3 | count, or -1
// Of textures, because software renderers load buffers lane by lane, number by number. Their bits are floats and integers.
layout(rgba32ui) readonly uniform uimage2D bvh_nodes;   // 2 texels a node, in rows one after the other
layout(rgba32ui) readonly uniform uimage2D bvh_faces;   // 3 a triangle: corner, 2 edges; w: rows of vertices
layout(std430) readonly buffer Vertices { float vertices[]; };    // VERTEX_FLOATS each (scene/gpu_mesh.py)

const int VERTEX_FLOATS = 12;
const int BVH_WIDTH = 1024;   // texels of a row
const float EDGE = 1e-5;   // barycentric: overlap of neighbours, so that no ray slips between them

const float PLACES = 4096.0;   // of a blended triangle's edge, each there or not

ivec2 texel_of_row(int i) { return ivec2(i & (BVH_WIDTH - 1), i / BVH_WIDTH); }

Node node_at(int i) {
    uvec4 low = imageLoad(bvh_nodes, texel_of_row(2 * i)), high = imageLoad(bvh_nodes, texel_of_row(2 * i + 1));
    return Node(uintBitsToFloat(low.xyz), int(low.w), uintBitsToFloat(high.xyz), int(high.w));
}

vec4 face_at(int i) { return uintBitsToFloat(imageLoad(bvh_faces, texel_of_row(i))); }

struct Ray { vec3 from; vec3 direction; };   // direction: unit length

// triangle: in the order of the hierarchy, -1 for none; place: barycentric of corners 1, 2
struct MeshHit { float distance; int triangle; vec2 place; };

// Distance at which the ray enters a box before `limit`; negative if it does not.
bool meets_box(vec3 low, vec3 high, vec3 from, vec3 inverse, float limit) {
    vec3 a = (low - from) * inverse, b = (high - from) * inverse;
    vec3 near = min(a, b), far = max(a, b);
    float enter = max(max(near.x, near.y), max(near.z, 0.0));
    return enter <= min(min(far.x, far.y), min(far.z, limit));
}

int material_of_triangle(int triangle) {
    return int(vertices[floatBitsToInt(face_at(3 * triangle).w) * VERTEX_FLOATS + 11]);
}

#ifdef CUTOUTS
// Whether a triangle's material is not there, at the barycentric place of corners 1 and 2.
bool is_open_at(int at, vec2 place) {
    ivec3 rows = VERTEX_FLOATS * floatBitsToInt(vec3(face_at(3 * at).w, face_at(3 * at + 1).w, face_at(3 * at + 2).w));
    vec3 weights = vec3(1.0 - place.x - place.y, place);
    vec2 uv = vec2(0.0);
    float clear = 0.0;
    for (int k = 0; k < 3; ++k) {
        uv += weights[k] * vec2(vertices[rows[k] + 6], vertices[rows[k] + 7]);
        clear += weights[k] * fract(vertices[rows[k] + 11]);
    }
    int material = material_of_triangle(at);
    return is_cut_out(material, opacity_of(material, uv, opacity_of_vertices(clear), 0.0), interleaved_gradient_noise(PLACES * place));
}
#endif

#ifdef HIDES_BACKS
bool is_hidden_back(int at, float det) {
    if (det > 0.0) return false;
    int material = material_of_triangle(at);
    return hides_back(material) && materials[material].emission.a == 0.0;
}
#else
bool is_hidden_back(int at, float det) { return false; }
#endif

// Moeller and Trumbore 1997, both sides.
void meet_triangle(int at, Ray ray, inout MeshHit hit) {
    vec3 corner = face_at(3 * at).xyz;
    vec3 e1 = face_at(3 * at + 1).xyz, e2 = face_at(3 * at + 2).xyz;
    vec3 p = cross(ray.direction, e2);
    float det = dot(e1, p);
    if (det == 0.0) return;
    vec3 s = ray.from - corner;
    float u = dot(s, p) / det;
    vec3 q = cross(s, e1);
    float v = dot(ray.direction, q) / det;
    float t = dot(e2, q) / det;
    if (u < -EDGE || v < -EDGE || u + v > 1.0 + EDGE || t <= 0.0 || t >= hit.distance) return;
    if (is_hidden_back(at, det)) return;
#ifdef CUTOUTS
    if (is_open_at(at, vec2(u, v))) return;
#endif
    hit = MeshHit(t, at, vec2(u, v));
}

// The hit nearest to the origin, or with `any_hit` the first that is found, before `limit`.
MeshHit hit_before(Ray ray, float limit, bool any_hit) {
    vec3 safe = mix(ray.direction, vec3(1e-12), lessThan(abs(ray.direction), vec3(1e-12)));
    vec3 inverse = 1.0 / safe;
    MeshHit hit = MeshHit(limit, -1, vec2(0.0));
    int nodes = node_at(0).skip;
    for (int i = 0; i < nodes && !(any_hit && hit.triangle >= 0);) {
        Node node = node_at(i);
        bool met = meets_box(node.low, node.high, ray.from, inverse, hit.distance);
        int first = node.leaf >> 3, count = met && node.leaf >= 0 ? node.leaf & 7 : 0;
        for (int j = first; j < first + count; ++j) meet_triangle(j, ray, hit);
        i = met ? i + 1 : node.skip;
    }
    return hit;
}

MeshHit closest_hit(Ray ray) { return hit_before(ray, 1e30, false); }

// Whether anything is nearer to the ray's origin than `limit`.
bool is_blocked(Ray ray, float limit) { return hit_before(ray, limit, true).triangle >= 0; }

struct MeshSurface { vec3 position; vec3 normal; vec2 uv; vec3 tint; int material; };

vec3 vertex_vector(ivec3 rows, int column, vec3 weights) {
    vec3 sum = vec3(0.0);
    for (int k = 0; k < 3; ++k) {
        int at = rows[k] * VERTEX_FLOATS + column;
        sum += weights[k] * vec3(vertices[at], vertices[at + 1], vertices[at + 2]);
    }
    return sum;
}

// The surface at a hit, its normal facing the ray's origin as the raster's faces the camera.
MeshSurface surface_of(MeshHit hit, Ray ray) {
    int at = 3 * hit.triangle;
    ivec3 rows = floatBitsToInt(vec3(face_at(at).w, face_at(at + 1).w, face_at(at + 2).w));
    vec3 weights = vec3(1.0 - hit.place.x - hit.place.y, hit.place);
    int material = int(vertices[rows.x * VERTEX_FLOATS + 11]);
    vec3 corner = vertex_vector(rows, 0, vec3(1.0, 0.0, 0.0));
    vec3 face = cross(vertex_vector(rows, 0, vec3(0.0, 1.0, 0.0)) - corner, vertex_vector(rows, 0, vec3(0.0, 0.0, 1.0)) - corner);
    if (dot(face, ray.direction) > 0.0) face = -face;
    vec3 mean = vertex_vector(rows, 3, weights), normal = normalize(mean == vec3(0.0) ? face : mean);
    if (dot(normal, ray.direction) > 0.0) normal = is_two_sided(material) ? -normal : normalize(face);
    vec2 uv = vertex_vector(rows, 6, weights).xy;
    return MeshSurface(ray.from + hit.distance * ray.direction, normal, uv, vertex_vector(rows, 8, weights), material);
}
