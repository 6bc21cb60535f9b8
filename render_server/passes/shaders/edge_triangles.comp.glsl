// Triangles of the objects at the edges that the picture has of them. FIND_THIN: marks the tiles of the raster in which a triangle may
// show that no texel's centre there shows, because it is thinner than a texel. Otherwise: which triangles may show in a marked tile, in
// the mesh's order; the others become points, which draw nothing.
#include "common/solid_mesh.glsl"
#include "common/camera.glsl"
#include "common/raster_tiles.glsl"
#include "common/walk.glsl"

layout(local_size_x = 64) in;
uniform mat4 clip_from_camera;
uniform uint triangle_count;

const int MOST_APART = 16;   // texels or tiles along an axis: a larger triangle is not looked at one by one

struct Projected { vec2 a; vec2 b; vec2 c; bool is_whole; };   // in texels; whole: beyond the near plane

vec2 texel_of(vec3 place, inout bool is_whole) {
    vec4 clip = clip_from_camera * (camera_from_world * vec4(place, 1.0));
    is_whole = is_whole && clip.z >= -clip.w && clip.w > 0.0;
    return (0.5 * clip.xy / clip.w + 0.5) * vec2(raster_size) - 0.5;
}

Projected projected(Piece t) {
    bool is_whole = true;
    vec2 a = texel_of(t.a.place, is_whole), b = texel_of(t.b.place, is_whole), c = texel_of(t.c.place, is_whole);
    return Projected(a, b, c, is_whole);
}

vec2 low_of(Projected p) { return min(min(p.a, p.b), p.c); }
vec2 high_of(Projected p) { return max(max(p.a, p.b), p.c); }

bool is_beside(Projected p) {
    return any(lessThan(high_of(p), vec2(-1.0))) || any(greaterThan(low_of(p), vec2(raster_size)));
}

#ifdef FIND_THIN
#include "common/geometry.glsl"
layout(std430) buffer Tiles { uint tiles[]; };

const float STOUT = 2.0;   // texels: the least height of a triangle that shows at a texel's centre for certain
const int MOST_BESIDE = 5;   // texels along an axis from the longest side: sqrt(2) STOUT, 2 REACH and rounding

bool is_stout(Projected p) {
    vec2 ab = p.b - p.a, ac = p.c - p.a, bc = p.c - p.b;
    float longest = sqrt(max(max(dot(ab, ab), dot(ac, ac)), dot(bc, bc)));
    return abs(ab.x * ac.y - ab.y * ac.x) > STOUT * longest;
}

// Whether a texel shows nothing, or what lies behind the plane (p, n), which faces the camera, by more than a texel spans there.
bool shows_behind(ivec2 texel, vec3 p, vec3 n) {
    vec4 shown = texelFetch(virtual_raster_position, texel, 0);
    return shown.w <= 0.0 || dot(shown.xyz - p, n) < -shown.w / raster_pinhole.x;
}

// Distance of p beyond the line from a to b, away from c, in units of the line's length.
float beyond(vec2 p, vec2 a, vec2 b, vec2 c, out float length_along_axes) {
    vec2 across = vec2(b.y - a.y, a.x - b.x);
    length_along_axes = abs(across.x) + abs(across.y);
    return dot(p - a, across) * (dot(c - a, across) > 0.0 ? -1.0 : 1.0);
}

// Whether the samples of a texel, or the square around them, meet a triangle whose bounds they meet.
bool meets(vec2 texel, Projected p) {
    vec3 reach;
    vec3 apart = vec3(beyond(texel, p.a, p.b, p.c, reach.x), beyond(texel, p.b, p.c, p.a, reach.y), beyond(texel, p.c, p.a, p.b, reach.z));
    return all(lessThanEqual(apart, REACH * reach));
}

void mark(ivec2 texel) { atomicOr(tiles[tile_number(tile_of(vec2(texel)))], THIN); }

// Marks what a large triangle meets that is not stout: it lies beside its longest side. Not all texels within its bounds, because
// Mesa's software renderer silently ends all loops of a thread after 65535 iterations.
void mark_along_longest(Projected p, ivec2 first, ivec2 last) {
    vec2 from = p.a, side = p.b - p.a;
    if (dot(p.c - p.a, p.c - p.a) > dot(side, side)) side = p.c - p.a;
    if (dot(p.c - p.b, p.c - p.b) > dot(side, side)) { from = p.b; side = p.c - p.b; }
    int along = abs(side.x) >= abs(side.y) ? 0 : 1, across = 1 - along;
    for (int i = first[along]; i <= last[along]; ++i) {
        int middle = int(round(from[across] + (float(i) - from[along]) * side[across] / side[along]));
        for (int j = max(middle - MOST_BESIDE, first[across]); j <= min(middle + MOST_BESIDE, last[across]); ++j) {
            ivec2 texel = along == 0 ? ivec2(i, j) : ivec2(j, i);
            if (meets(vec2(texel), p)) mark(texel);
        }
    }
}

void find_thin(Piece t) {
    Projected at = projected(t);
    vec3 n = cross(t.b.place - t.a.place, t.c.place - t.a.place);
    float size = length(n);
    if (!at.is_whole || size == 0.0 || is_beside(at)) return;
    n *= (dot(n, camera_position - t.a.place) < 0.0 ? -1.0 : 1.0) / size;
    ivec2 first = max(ivec2(ceil(low_of(at) - REACH)), ivec2(0)), last = min(ivec2(floor(high_of(at) + REACH)), raster_size - 1);
    if (any(greaterThan(last - first, ivec2(MOST_APART)))) {
        if (!is_stout(at)) mark_along_longest(at, first, last);
        return;
    }
    for (int y = first.y; y <= last.y; ++y)
        for (int x = first.x; x <= last.x; ++x)
            if (meets(vec2(x, y), at) && shows_behind(ivec2(x, y), t.a.place, n)) mark(ivec2(x, y));
}

void main() {
    for (uint i = first_item(); i < triangle_count; i += items_apart()) find_thin(triangle_at(i));
}
#else
layout(std430) readonly buffer Tiles { uint tiles[]; };
layout(std430) writeonly buffer EdgeIndices { uint edge_indices[]; };

const float MARGIN = 0.02;   // texels, for rounding

bool is_marked(ivec2 low, ivec2 high) {
    for (int y = low.y; y <= high.y; ++y)
        for (int x = low.x; x <= high.x; ++x)
            if (tiles[tile_number(ivec2(x, y))] != 0u) return true;
    return false;
}

bool is_taken(Piece t) {
    Projected at = projected(t);
    if (!at.is_whole) return true;
    if (is_beside(at)) return false;
    ivec2 first = tile_of(max(low_of(at) - MARGIN, vec2(0.0))), last = tile_of(min(high_of(at) + MARGIN, vec2(raster_size)));
    return any(greaterThan(last - first, ivec2(MOST_APART))) || is_marked(first, last);
}

void main() {
    for (uint i = first_item(); i < triangle_count; i += items_apart()) {
        bool taken = is_taken(triangle_at(i));
        for (uint k = 3u * i; k < 3u * i + 3u; ++k) edge_indices[k] = taken ? indices[k] : 0u;
    }
}
#endif
