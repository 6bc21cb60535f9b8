// A ball around the surfaces that need light in each tile, of real surfaces and below them of objects: its middle and radius, world m.
#include "common/geometry.glsl"
#include "common/beam_footprint.glsl"
#include "common/beam_tiles.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
layout(rgba32f) writeonly uniform image2D tile_balls;

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(at, tiles * ivec2(1, 2)))) return;
    int layer = at.y < tiles.y ? REAL_LAYER : OBJECT_LAYER;
    ivec2 first = TILE * (at - ivec2(0, layer == REAL_LAYER ? 0 : tiles.y));
    vec3 low = vec3(1e9), high = vec3(-1e9);
    for (int i = 0; i < TILE * TILE; ++i) {
        LitTexel t = lit_texel(first + ivec2(i % TILE, i / TILE), layer);
        low = min(low, t.needed ? t.p : low);
        high = max(high, t.needed ? t.p : high);
    }
    bool any_needed = low.x <= high.x;
    imageStore(tile_balls, at, any_needed ? vec4(0.5 * (low + high), 0.5 * distance(low, high)) : vec4(0.0, 0.0, 0.0, -1e9));
}
