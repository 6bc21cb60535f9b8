// Voxelises triangles exactly: each is clipped against every voxel that it may touch (Schwarz & Seidel 2010 find the
// same voxels); area and centroid of each piece become a surfel. Thin, large and tiny triangles keep their area.
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
vec3 polygon[MAX_CORNERS];
int corners;

// Keeps the part of the polygon where side * (x[axis] - plane) >= 0 (Sutherland & Hodgman 1974).
void clip(int axis, float plane, float side) {
    vec3 kept[MAX_CORNERS];
    int count = 0;
    for (int i = 0; i < corners; ++i) {
        vec3 a = polygon[i], b = polygon[i + 1 == corners ? 0 : i + 1];
        float da = side * (a[axis] - plane), db = side * (b[axis] - plane);
        if (da >= 0.0 && count < MAX_CORNERS) kept[count++] = a;
        if ((da > 0.0 && db < 0.0) || (da < 0.0 && db > 0.0))
            if (count < MAX_CORNERS) kept[count++] = mix(a, b, da / (da - db));
    }
    corners = count;
    for (int i = 0; i < count; ++i) polygon[i] = kept[i];
}

// Clips against the six faces of a voxel, skipping the slabs that contain the whole triangle.
void clip_to_voxel(ivec3 voxel, bvec3 cut) {
    for (int face = 0; face < 6 && corners > 2; ++face) {
        int axis = face >> 1, upper = face & 1;
        if (cut[axis]) clip(axis, float(voxel[axis] + upper), upper == 0 ? 1.0 : -1.0);
    }
}

// Area-weighted centroid and area of the polygon (voxel units).
vec4 centroid_area() {
    vec3 centre = vec3(0.0);
    float area = 0.0;
    for (int i = 1; i + 1 < corners; ++i) {
        float a = 0.5 * length(cross(polygon[i] - polygon[0], polygon[i + 1] - polygon[0]));
        centre += a * (polygon[0] + polygon[i] + polygon[i + 1]) / 3.0;
        area += a;
    }
    return vec4(area > 0.0 ? centre / area : polygon[0], area);
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
    for (int x = first.x; x <= last.x; ++x)
        for (int y = first.y; y <= last.y; ++y)
            for (int z = first.z; z <= last.z; ++z) {
                polygon[0] = a; polygon[1] = b; polygon[2] = c;
                corners = 3;
                clip_to_voxel(ivec3(x, y, z), cut);
                if (corners > 2) emit(t, centroid_area(), ivec3(x, y, z), a, b, c, n);
            }
}
