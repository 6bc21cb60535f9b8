// Voxelises triangles exactly: each is clipped to the layers of voxels along x, each part along y, then along z (Schwarz &
// Seidel 2010 find the same voxels); area and centroid of each piece become a surfel. Thin, large and tiny triangles keep their area.
#include "common/volume.glsl"
#define GRID_ACCESS
#define TOUCHED_ACCESS
#define SURFELS_ACCESS
#define SUMS_ACCESS
#include "common/voxel_store.glsl"

layout(local_size_x = 64) in;

struct Corner { float p[3]; float uv[2]; float tint[3]; float material; float double_sided; };
struct Triangle { Corner corners[3]; };
layout(std430) readonly buffer Triangles { Triangle triangles[]; };
uniform int triangle_count;

const int MAX_CORNERS = 10;
struct Polygon { int corners; vec3 p[MAX_CORNERS]; };

// The part of a polygon where side * (x[axis] - plane) >= 0 (Sutherland & Hodgman 1974).
Polygon clip(Polygon given, int axis, float plane, float side) {
    Polygon kept;
    kept.corners = 0;
    for (int i = 0; i < given.corners; ++i) {
        vec3 a = given.p[i], b = given.p[i + 1 == given.corners ? 0 : i + 1];
        float da = side * (a[axis] - plane), db = side * (b[axis] - plane);
        if (da >= 0.0 && kept.corners < MAX_CORNERS) kept.p[kept.corners++] = a;
        if ((da > 0.0 && db < 0.0) || (da < 0.0 && db > 0.0))
            if (kept.corners < MAX_CORNERS) kept.p[kept.corners++] = mix(a, b, da / (da - db));
    }
    return kept;
}

// The part in one layer of voxels; a triangle that lies `within` one is not cut.
Polygon clip_to_layer(Polygon given, int axis, int layer, bool within) {
    if (within) return given;
    Polygon above = clip(given, axis, float(layer), 1.0);
    if (above.corners < 3) return above;
    return clip(above, axis, float(layer + 1), -1.0);
}

// First and last layer that a polygon may touch, among `limits`.
ivec2 layers_of(Polygon given, int axis, ivec2 limits) {
    float low = 1e9, high = -1e9;
    for (int i = 0; i < given.corners; ++i) {
        low = min(low, given.p[i][axis]);
        high = max(high, given.p[i][axis]);
    }
    return ivec2(max(int(floor(low)), limits.x), min(int(floor(high)), limits.y));
}

// Area-weighted centroid and area of the polygon (voxel units).
vec4 centroid_area(Polygon given) {
    vec3 centre = vec3(0.0);
    float area = 0.0;
    for (int i = 1; i + 1 < given.corners; ++i) {
        float a = 0.5 * length(cross(given.p[i] - given.p[0], given.p[i + 1] - given.p[0]));
        centre += a * (given.p[0] + given.p[i] + given.p[i + 1]) / 3.0;
        area += a;
    }
    return vec4(area > 0.0 ? centre / area : given.p[0], area);
}

void touch(uint voxel) {
    if (atomicCompSwap(grid[voxel], 0u, 0xffffffffu) != 0u) return;
    uint slot = atomicAdd(slot_count, 1u);
    touched[slot] = voxel;
    atomicExchange(grid[voxel], slot + 1u);   // others compare and swap it
    for (int i = 0; i < SUMS_PER_SLOT; ++i) sums[int(slot) * SUMS_PER_SLOT + i] = 0;
}

vec3 corner_position(Corner c) { return vec3(c.p[0], c.p[1], c.p[2]); }
vec2 corner_uv(Corner c) { return vec2(c.uv[0], c.uv[1]); }
vec3 corner_tint(Corner c) { return vec3(c.tint[0], c.tint[1], c.tint[2]); }

vec2 uv_at(Triangle t, vec3 p, vec3 a, vec3 b, vec3 c, vec3 n) {
    float whole = dot(n, n);
    float wb = dot(cross(p - a, c - a), n) / whole, wc = dot(cross(b - a, p - a), n) / whole;
    return (1.0 - wb - wc) * corner_uv(t.corners[0]) + wb * corner_uv(t.corners[1]) + wc * corner_uv(t.corners[2]);
}

void emit(Triangle t, vec4 piece, ivec3 voxel, vec3 a, vec3 b, vec3 c, vec3 n) {
    if (piece.w < 1e-9) return;
    uint index = atomicAdd(surfel_count, 1u);
    if (index >= uint(surfels.length())) return;
    uint v = voxel_index(voxel, volume_size);
    touch(v);
    surfels[index].position_area =
        vec4(volume_origin + piece.xyz * voxel_edge, piece.w * voxel_edge * voxel_edge);
    surfels[index].normal_material = vec4(normalize(n), t.corners[0].material);
    surfels[index].uv_voxel = vec4(uv_at(t, piece.xyz, a, b, c, n), uintBitsToFloat(v), t.corners[0].double_sided);
    surfels[index].tint =
        vec4((corner_tint(t.corners[0]) + corner_tint(t.corners[1]) + corner_tint(t.corners[2])) / 3.0, 1.0);
}

void main() {
    int i = int(gl_GlobalInvocationID.x);
    if (i >= triangle_count) return;
    Triangle t = triangles[i];
    vec3 a = volume_coordinate(corner_position(t.corners[0]));
    vec3 b = volume_coordinate(corner_position(t.corners[1]));
    vec3 c = volume_coordinate(corner_position(t.corners[2]));
    vec3 n = cross(b - a, c - a);
    if (dot(n, n) == 0.0) return;
    ivec3 low = ivec3(floor(min(a, min(b, c)))), high = ivec3(floor(max(a, max(b, c))));
    ivec3 first = max(low, ivec3(0)), last = min(high, ivec3(volume_size - 1));
    bvec3 cut = notEqual(low, high);
    if (!any(cut)) {   // most triangles of a depth mesh are within one voxel
        if (first == last) emit(t, vec4((a + b + c) / 3.0, 0.5 * length(n)), first, a, b, c, n);   // rounding may put it outside
        return;
    }
    Polygon whole;
    whole.corners = 3;
    whole.p[0] = a; whole.p[1] = b; whole.p[2] = c;
    for (int x = first.x; x <= last.x; ++x) {
        Polygon in_x = clip_to_layer(whole, 0, x, !cut.x);
        ivec2 ys = layers_of(in_x, 1, ivec2(first.y, last.y));
        for (int y = ys.x; in_x.corners > 2 && y <= ys.y; ++y) {
            Polygon in_xy = clip_to_layer(in_x, 1, y, !cut.y);
            ivec2 zs = layers_of(in_xy, 2, ivec2(first.z, last.z));
            for (int z = zs.x; in_xy.corners > 2 && z <= zs.y; ++z) {
                Polygon piece = clip_to_layer(in_xy, 2, z, !cut.z);
                if (piece.corners > 2) emit(t, centroid_area(piece), ivec3(x, y, z), a, b, c, n);
            }
        }
    }
}
