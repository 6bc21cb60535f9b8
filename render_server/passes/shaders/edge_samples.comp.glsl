// The samples after the first of the pixels where they may differ: of the triangles in the lists of the pixel's tiles, which is nearest
// on the ray of each sample. Where a list had no room for all, the first sample stands for all.
#include "common/samples.glsl"
#include "common/work_list.glsl"
#include "common/raster_tiles.glsl"
#include "common/mesh_fragment.glsl"

layout(local_size_x = 64) in;
layout(rgba32f) uniform image2D position_out;
layout(rgba16f) uniform image2D normal_out;
layout(rg32f) writeonly uniform image2D uv_out;
layout(rgba8) writeonly uniform image2D tint_out;
#ifdef PACKS_EXTENDED
layout(rgba32ui) writeonly uniform uimage2D extended_out;
#endif
layout(rgba16f) uniform image2D sample_coverage;   // as in sample_coverage.comp.glsl
// samples of another surface: the first one's position, w: their fraction
layout(rgba32f) writeonly uniform image2D second_surface;
layout(std430) readonly buffer Tiles { Tile tiles[]; };
layout(std430) readonly buffer EdgeNodes { uint node_count; uint unused; uvec2 nodes[]; };   // triangle, next node + 1

const vec2 OFFSETS[SAMPLES] = OFFSETS_PX;   // of all samples, in their order
const float WEIGHT = 1.0 / float(SAMPLES);
const float EDGE = 1e-5;   // weights: overlap of neighbours, so that no ray slips between them
const uint NONE = 0xffffffffu;

// Of the pixel: rays have length 1 along the optical axis.
vec3 ray, right, down;
float depth[SAMPLES];
uint nearest[SAMPLES];
vec2 place;

void begin_pixel(ivec2 pixel) {
    place = place_in_raster(pixel);
    mat3 world = mat3(world_from_camera);
    ray = world * vec3((place - raster_pinhole.zw) / raster_pinhole.xy, 1.0);
    right = world[0] / raster_pinhole.x;
    down = world[1] / raster_pinhole.y;
    for (int k = 1; k < SAMPLES; ++k) {
        depth[k] = 1e30;
        nearest[k] = NONE;
    }
}

vec3 ray_of_sample(int k) { return ray + OFFSETS[k].x * right + OFFSETS[k].y * down; }

#ifdef CUTOUTS
bool is_there(uint triangle, int k) {
    vec2 texel = floor(place + 0.5) + 0.5;
    return !is_left_out(fragment_at(triangle, ray_of_sample(k), right, down), texel, float(k) * WEIGHT);
}
#else
bool is_there(uint triangle, int k) { return true; }
#endif

void intersect(uint triangle) {
    Plane plane = plane_of(corners_of(triangle));
    mat3 products = mat3(plane.normal, plane.u, plane.v);   // of all three with a ray: linear in it
    vec3 at = ray * products, beside = right * products, below = down * products;
    for (int k = 1; k < SAMPLES; ++k) {
        vec3 found = at + OFFSETS[k].x * beside + OFFSETS[k].y * below;
        float scale = 1.0 / found.x, z = plane.height * scale;
        vec2 uv = found.yz * scale;
        bool is_nearer = z < depth[k] || (z == depth[k] && triangle < nearest[k]);
        bool is_met = found.x != 0.0 && all(greaterThanEqual(vec3(uv, 1.0 - uv.x - uv.y), vec3(-EDGE)));
        if (is_met && z >= NEAR && is_nearer && is_there(triangle, k)) {
            depth[k] = z;
            nearest[k] = triangle;
        }
    }
}

const int LISTS = 4 * LEVELS;

// The list of the next tile around the place that is another one than those of its level before: the first node + 1, 0 if it is empty.
uint next_list(inout int list, inout int first, inout int before) {
    ++list;
    int corner = list & 3, tile = tile_around(place, corner ^ (corner >> 1), list >> 2);
    bool is_new = corner == 0 || (tile != before && tile != first);   // corners that follow one another may share a tile
    if (corner == 0) first = tile;
    before = tile;
    return is_new ? tiles[tile].first : 0u;
}

// Intersects the rays with all triangles of the lists; false if one of them is not whole. All in one loop, so that no lane waits for the lists of others.
bool intersect_lists() {
    int list = -1, first = -1, before = -1;
    uint at = 0u;
    do {
        do {
            if (at == 0u && list < LISTS - 1) at = next_list(list, first, before);
        } while (at == 0u && list < LISTS - 1);
        if (at == FULL) return false;
        if (at != 0u) {
            uvec2 node = nodes[at - 1u];
            intersect(node.x);
            at = node.y;
        }
    } while (at != 0u || list < LISTS - 1);
    return true;
}

Fragment fragment_of(int k, uint triangle) { return fragment_at(triangle, ray_of_sample(k), right, down); }

// Samples come in the order of their distance from the centre: the first visible one represents the pixel, or the first hidden one if
// none is visible; NONE: that of the raster.
void sum_up(ivec2 pixel, inout vec4 sum, out uint shown, out int sample_shown) {
    shown = NONE;
    sample_shown = 0;
    for (int k = 1; k < SAMPLES; ++k) {
        if (nearest[k] == NONE) continue;
        bool seen = in_front(pixel, depth[k]) > 0.0;
        if (sum.r == 0.0 && (seen || sum.g == 0.0)) {
            shown = nearest[k];
            sample_shown = k;
        }
        sum += WEIGHT * covered(seen, depth[k]);
    }
}

void store(ivec2 pixel, Surface s) {
    imageStore(position_out, pixel, s.position);
    imageStore(normal_out, pixel, s.normal);
    imageStore(uv_out, pixel, vec4(s.uv, 0.0, 0.0));
    imageStore(tint_out, pixel, s.tint);
#ifdef PACKS_EXTENDED
    imageStore(extended_out, pixel, s.extended);
#endif
}

// The samples, as bits, that are visible, come after the one that represents the pixel, and show another triangle.
uint samples_beside(ivec2 pixel, uint shown, int sample_shown) {
    uint beside = 0u;
    for (int k = 1; k < SAMPLES; ++k) {
        bool counts = k > sample_shown && nearest[k] != NONE && nearest[k] != shown && in_front(pixel, depth[k]) > 0.0;
        beside |= uint(counts) << k;
    }
    return beside;
}

uint samples_of(uint triangle) {
    uint samples = 0u;
    for (int k = 1; k < SAMPLES; ++k) samples |= uint(nearest[k] == triangle) << k;
    return samples;
}

// Position of the first of those samples that shows another surface; their fraction. One of each triangle speaks for all.
vec4 second_of(uint beside, vec3 position, vec3 normal) {
    vec4 second = vec4(0.0);
    while (beside != 0u) {
        int first = findLSB(beside);
        uint same = beside & samples_of(nearest[first]);
        Surface s = surface_at(fragment_of(first, nearest[first]), false);
        if (is_another(position, normal, s.position, s.normal.xyz))
            second = vec4(second.w > 0.0 ? second.xyz : s.position.xyz, second.w + WEIGHT * float(bitCount(same)));
        beside &= ~same;
    }
    return second;
}

void add_samples(ivec2 pixel) {
    vec4 sum = imageLoad(sample_coverage, pixel);
    uint shown;
    int sample_shown;
    sum_up(pixel, sum, shown, sample_shown);
    imageStore(sample_coverage, pixel, sum);
    vec3 position = imageLoad(position_out, pixel).xyz, normal = imageLoad(normal_out, pixel).xyz;
    if (shown != NONE) {
        Surface s = surface_at(fragment_of(sample_shown, shown), true);
        store(pixel, s);
        position = s.position.xyz;
        normal = s.normal.xyz;
    }
    vec4 second = second_of(samples_beside(pixel, shown, sample_shown), position, normal);
    if (second.w > 0.0) imageStore(second_surface, pixel, second);
}

void sample_pixel(ivec2 pixel) {
    begin_pixel(pixel);
    if (intersect_lists()) add_samples(pixel);
    else imageStore(sample_coverage, pixel, float(SAMPLES) * imageLoad(sample_coverage, pixel));
}

void main() {
    uint i = counted_group() * 64u + gl_LocalInvocationIndex;
    if (i < listed_count()) sample_pixel(texel_of_index(texels[i], int(picture_size.x)));
}
