// Triangles of the objects at the edges that the picture has of them. FIND_THIN: marks the tiles of the raster in which a triangle may
// show that no texel's centre there shows, because it is thinner than a texel. Otherwise: lists the triangles that may show in a marked
// tile; a large one in the lists of larger tiles, marked or not; and counts the workgroups of edge_samples.comp.glsl, whose list is
// complete by now. HIDES_BACKS: some triangles are not seen from behind.
#include "common/plane.glsl"
#include "common/raster_tiles.glsl"
#include "common/walk.glsl"
#pragma switch HIDES_BACKS

layout(local_size_x = 64) in;
layout(std430) buffer Tiles { Tile tiles[]; };
uniform mat4 clip_from_world;
uniform uint triangle_count;

#ifdef HIDES_BACKS
layout(std430) readonly buffer Sides { float sides[]; };   // of each material, as flags.x in common/materials.glsl

bool is_hidden(uint triangle, mat3 corners) {
    vec3 n = cross(corners[1] - corners[0], corners[2] - corners[0]);
    return dot(n, corners[0] - camera_position) > 0.0 && sides[material_of(triangle)] < 0.0;
}
#else
bool is_hidden(uint triangle, mat3 corners) { return false; }
#endif

// In texels; whole: beyond the near plane; beside: all of it before that plane, or beyond one side of the raster.
struct Projected { vec2 a; vec2 b; vec2 c; bool is_whole; bool is_beside; };

vec4 clip_of(vec3 place) { return clip_from_world * vec4(place, 1.0); }

bool is_beyond_near(vec4 clip) { return clip.z >= -clip.w && clip.w > 0.0; }

vec2 texel_of(vec4 clip) { return (0.5 * clip.xy / clip.w + 0.5) * vec2(raster_size) - 0.5; }

// Beyond which sides a point lies, also behind the camera: left, right, above, below. A texel beyond a side still counts as inside.
bvec4 sides_of(vec4 clip) {
    vec2 edge = (1.0 + 2.0 / vec2(raster_size)) * clip.w;
    return bvec4(lessThan(clip.xy, -edge), greaterThan(clip.xy, edge));
}

Projected projected(mat3 corners) {
    vec4 a = clip_of(corners[0]), b = clip_of(corners[1]), c = clip_of(corners[2]);
    bvec4 one = sides_of(a), other = sides_of(b), last = sides_of(c);
    bvec3 beyond_near = bvec3(is_beyond_near(a), is_beyond_near(b), is_beyond_near(c));
    bool is_beside = !any(beyond_near);
    for (int i = 0; i < 4; ++i) is_beside = is_beside || (one[i] && other[i] && last[i]);
    return Projected(texel_of(a), texel_of(b), texel_of(c), all(beyond_near), is_beside);
}

vec2 low_of(Projected p) { return min(min(p.a, p.b), p.c); }
vec2 high_of(Projected p) { return max(max(p.a, p.b), p.c); }

// Distance of p beyond the line from a to b, away from c, in units of the line's length.
float beyond(vec2 p, vec2 a, vec2 b, vec2 c, out float length_along_axes) {
    vec2 across = vec2(b.y - a.y, a.x - b.x);
    length_along_axes = abs(across.x) + abs(across.y);
    return dot(p - a, across) * (dot(c - a, across) > 0.0 ? -1.0 : 1.0);
}

// Whether a square around a middle, of edges 2 `reach`, meets a triangle whose bounds it meets.
bool meets(vec2 middle, float reach, Projected p) {
    vec3 l;
    vec3 distances = vec3(beyond(middle, p.a, p.b, p.c, l.x), beyond(middle, p.b, p.c, p.a, l.y), beyond(middle, p.c, p.a, p.b, l.z));
    return all(lessThanEqual(distances, reach * l));
}

// The next of the texels or tiles from `first` to `last`, row by row. (Of two nested loops, each would execute its body once more, with all lanes masked.)
ivec2 next_in(ivec2 at, ivec2 first, ivec2 last) { return at.x < last.x ? ivec2(at.x + 1, at.y) : ivec2(first.x, at.y + 1); }

#ifdef FIND_THIN
#include "common/geometry.glsl"
const int MOST_TEXELS = 16;   // along an axis: those of a larger triangle are not looked at one by one
const float STOUT = 2.0;   // texels: the least height of a triangle that shows at a texel's centre for certain
const int MOST_BESIDE = 5;   // texels along an axis from the longest side: sqrt(2) STOUT, 2 HALF and rounding
const float HALF = 0.5;      // texels: through a lens, samples may lie anywhere in a texel

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

void mark(ivec2 texel) { atomicOr(tiles[tile_number(tile_of(vec2(texel), 0), 0)].marks, THIN); }

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
            if (meets(vec2(texel), HALF, p)) mark(texel);
        }
    }
}

void find_thin(uint triangle) {
    mat3 corners = corners_of(triangle);
    Projected at = projected(corners);
    vec3 n = cross(corners[1] - corners[0], corners[2] - corners[0]);
    float size = length(n);
    if (!at.is_whole || size == 0.0 || at.is_beside || is_hidden(triangle, corners)) return;
    n *= (dot(n, camera_position - corners[0]) < 0.0 ? -1.0 : 1.0) / size;
    ivec2 first = max(ivec2(ceil(low_of(at) - HALF)), ivec2(0)), last = min(ivec2(floor(high_of(at) + HALF)), raster_size - 1);
    if (any(greaterThan(last - first, ivec2(MOST_TEXELS)))) {
        if (!is_stout(at)) mark_along_longest(at, first, last);
        return;
    }
    ivec2 texel = first;
    if (all(lessThanEqual(first, last))) do {
        if (meets(vec2(texel), HALF, at) && shows_behind(texel, corners[0], n)) mark(texel);
        texel = next_in(texel, first, last);
    } while (texel.y <= last.y);
}

void main() {
    uint i = first_item();
    if (i < triangle_count) do find_thin(i); while ((i += items_apart()) < triangle_count);
}
#else
#include "common/counted_groups.glsl"
layout(std430) buffer EdgeNodes { uint node_count; uint unused; uvec2 nodes[]; };   // triangle, next node + 1

const float MARGIN = 0.02;   // texels, for rounding

void add_to_list(int tile, uint triangle) {
    uint node = atomicAdd(node_count, 1u);
    bool fits = node < uint(nodes.length());
    uint next = atomicExchange(tiles[tile].first, fits ? node + 1u : FULL);
    if (fits) nodes[node] = uvec2(triangle, next);
}

void add_to_tiles(uint triangle, Projected p, ivec2 first, ivec2 last, int level) {
    float edge = float(1 << tile_bits(level));
    ivec2 at = first;
    do {
        int tile = tile_number(at, level);
        bool is_wanted = level > 0 || tiles[tile].marks != 0u;
        vec2 middle = edge * (vec2(at) + 0.5) - 0.5;
        if (is_wanted && (!p.is_whole || meets(middle, 0.5 * edge + MARGIN, p))) add_to_list(tile, triangle);
        at = next_in(at, first, last);
    } while (at.y <= last.y);
}

// One that is not whole may be anywhere.
void list(uint triangle) {
    mat3 corners = corners_of(triangle);
    Projected at = projected(corners);
    if (at.is_beside || is_hidden(triangle, corners)) return;
    vec2 low = at.is_whole ? low_of(at) - MARGIN : vec2(0.0), high = at.is_whole ? high_of(at) + MARGIN : vec2(raster_size);
    int level = at.is_whole ? 0 : LEVELS - 1;
    while (level < LEVELS - 1 && any(greaterThanEqual(tile_of(high, level) - tile_of(low, level), ivec2(MOST_TILES)))) ++level;
    add_to_tiles(triangle, at, tile_of(low, level), tile_of(high, level), level);
}

void main() {
    if (gl_GlobalInvocationID.x == 0u) count_groups();
    uint i = first_item();
    if (i < triangle_count) do list(i); while ((i += items_apart()) < triangle_count);
}
#endif
