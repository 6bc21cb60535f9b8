// Voxelises triangles exactly (Schwarz & Seidel 2010 find the same voxels): each is clipped to the voxels that it may meet, which
// voxel_pairs lists; area and centroid of each piece become a surfel. Thin, large and tiny triangles keep their area.
#include "common/volume.glsl"
#include "common/walk.glsl"
#define GRID_ACCESS
#define TOUCHED_ACCESS
#define SURFELS_ACCESS
#define SUMS_ACCESS
#include "common/voxel_store.glsl"
#define PAIRS_ACCESS readonly
#include "common/voxel_pieces.glsl"

layout(local_size_x = 64) in;
layout(std430) readonly buffer Sides { float double_sided[]; };   // of each material

// A half plane of the piece's plane, seen along the axis nearest to its normal: dot(xy, p) + z >= 0, xy of length 1.
const int LINES = 9;                           // three edges, and six faces of the voxel
const vec3 EVERYWHERE = vec3(1.0, 0.0, 1e3), NOWHERE = vec3(1.0, 0.0, -1e3);   // near the voxel
const float PARALLEL = 1e-6;                   // sine: over a voxel's edge, less than what is measured
const float LEAST_AREA = 1e-7;                 // of a part: below, rounding

// Of two lines. `precise`: that of the lines in turn differs by its sign alone. So each is cut at the very point xy / z where both
// cross, and the outline stays closed under rounding.
vec3 crossed(vec3 one, vec3 other) {
    precise vec3 product = one.yzx * other.zxy - one.zxy * other.yzx;
    return product;
}

// Cuts the stretch `kept` of line i (running along `along` from `base`) by half plane j (Cyrus & Beck 1978). Of two lines that
// coincide, the first counts.
void cut(inout vec2 kept, vec3 line, vec3 other, bool first, vec2 base, vec2 along) {
    vec3 product = crossed(line, other);
    if (abs(product.z) < PARALLEL) {
        float gap = dot(line.xy, other.xy) > 0.0 ? other.z - line.z : other.z + line.z;
        if (gap < 0.0 || (gap == 0.0 && !first && dot(line.xy, other.xy) > 0.0)) kept.y = kept.x;
        return;
    }
    float at = dot(product.xy / product.z - base, along);
    if (product.z < 0.0) kept.x = max(kept.x, at);
    else kept.y = min(kept.y, at);
}

vec3 line_through(vec2 a, vec2 b, float side) {
    vec2 n = side * normalize(vec2(a.y - b.y, b.x - a.x));
    return vec3(n, -dot(n, a));
}

// The voxel's faces at 0 and 1 across a plane coordinate dot(slope.xy, p) + slope.z; none if the triangle lies `within`.
void face_lines(inout vec3 lines[LINES], int at, vec3 slope, bool within) {
    float size = length(slope.xy);
    bool level = size < PARALLEL, between = slope.z >= 0.0 && slope.z < 1.0;
    vec3 whole = within || between ? EVERYWHERE : NOWHERE;
    lines[at] = within || level ? whole : slope / size;
    lines[at + 1] = within || level ? whole : vec3(-slope.xy, 1.0 - slope.z) / size;
}

// Area-weighted centroid and area of the part of a triangle in the voxel at the origin (voxel units): integrals along its
// outline (Green's theorem), without a list of corners, which software renderers keep in memory.
vec4 centroid_area(vec3 a, vec3 b, vec3 c, vec3 n, bvec3 within) {
    vec3 size = abs(n);
    int w = size.x > size.y ? (size.x > size.z ? 0 : 2) : (size.y > size.z ? 1 : 2), u = (w + 1) % 3, v = (w + 2) % 3;
    vec2 pa = vec2(a[u], a[v]), pb = vec2(b[u], b[v]), pc = vec2(c[u], c[v]);
    vec2 slope = -vec2(n[u], n[v]) / n[w];
    vec3 height = vec3(slope, a[w] - dot(slope, pa));   // the coordinate along w at a point
    vec3 lines[LINES];
    lines[0] = line_through(pa, pb, sign(n[w]));
    lines[1] = line_through(pb, pc, sign(n[w]));
    lines[2] = line_through(pc, pa, sign(n[w]));
    face_lines(lines, 3, vec3(1.0, 0.0, 0.0), within[u]);
    face_lines(lines, 5, vec3(0.0, 1.0, 0.0), within[v]);
    face_lines(lines, 7, height, within[w]);
    vec3 sum = vec3(0.0);
    for (int i = 0; i < LINES; ++i) {
        vec3 line = lines[0];
        vec2 along = vec2(line.y, -line.x), base = -line.z * line.xy, kept = vec2(-1e4, 1e4);
        for (int j = 1; j < LINES; ++j) {
            cut(kept, line, lines[j], i + j < LINES, base, along);
            lines[j - 1] = lines[j];   // the next line comes to the front: a number that changes would make drivers unroll both loops
        }
        lines[LINES - 1] = line;
        if (kept.x >= kept.y) continue;
        vec2 p = base + kept.x * along, q = base + kept.y * along;
        float part = 0.5 * (p.x * q.y - p.y * q.x);
        sum += part * vec3((p + q) / 3.0, 1.0);
    }
    if (sum.z < LEAST_AREA) return vec4(0.0);
    vec2 centre = clamp(sum.xy / sum.z, vec2(0.0), vec2(1.0));
    vec3 found;
    found[u] = centre.x;
    found[v] = centre.y;
    found[w] = clamp(dot(height, vec3(centre, 1.0)), 0.0, 1.0);
    return vec4(found, sum.z * length(n) / size[w]);
}

// Gives a voxel a slot, unless it has one.
void allocate_slot(uint voxel) {
    if (atomicCompSwap(grid[voxel], 0u, 0xffffffffu) != 0u) return;
    uint slot = atomicAdd(slot_count, 1u);
    touched[slot] = voxel;
    atomicExchange(grid[voxel], slot + 1u);   // others compare and swap it
    int at = int(slot) * SUMS_PER_SLOT, end = at + SUMS_PER_SLOT;
    do sums[at] = 0; while (++at < end);
}

vec2 uv_at(Piece t, vec3 p, vec3 a, vec3 b, vec3 c, vec3 n) {
    float whole = dot(n, n);
    float wb = dot(cross(p - a, c - a), n) / whole, wc = dot(cross(b - a, p - a), n) / whole;
    return (1.0 - wb - wc) * t.a.uv + wb * t.b.uv + wc * t.c.uv;
}

void emit(Piece t, int material, vec4 part, ivec3 voxel, vec3 a, vec3 b, vec3 c, vec3 n) {
    if (part.w < 1e-9) return;
    uint index = atomicAdd(surfel_count, 1u);
    if (index >= uint(surfels.length())) return;
    uint v = voxel_index(voxel + ivec3(0, 0, volume * volume_size), volume_size);
    allocate_slot(v);
    surfels[index].position_area = vec4(volume_origin + part.xyz * voxel_edge, part.w * voxel_edge * voxel_edge);
    surfels[index].normal_material = vec4(normalize(n), float(material));
    surfels[index].uv_voxel = vec4(uv_at(t, part.xyz, a, b, c, n), uintBitsToFloat(v), double_sided[material]);
    surfels[index].tint = (t.a.tint + t.b.tint + t.c.tint) / 3.0;
}

void clip_to_voxel(Pair pair) {
    enter_filling_of(pair.triangle);
    Piece t = piece_of(pair.triangle, pair.path);
    int material = material_of(number_of(pair.triangle));
    ivec3 voxel = voxel_of_bits(pair.voxel);
    vec3 a = volume_coordinate(t.a.place), b = volume_coordinate(t.b.place), c = volume_coordinate(t.c.place);
    vec3 n = cross(b - a, c - a);
    bvec3 within = equal(ivec3(floor(min(a, min(b, c)))), ivec3(floor(max(a, max(b, c)))));
    vec4 part = vec4((a + b + c) / 3.0, 0.5 * length(n));
    if (!all(within)) {   // few triangles of a depth mesh
        vec3 corner = vec3(voxel);
        part = centroid_area(a - corner, b - corner, c - corner, n, within) + vec4(corner, 0.0);
    }
    emit(t, material, part, voxel, a, b, c, n);
}

void main() {
    uint count = min(pair_count, uint(pairs.length()));
    for (uint i = first_item(); i < count; i += items_apart()) clip_to_voxel(pairs[i]);
}
