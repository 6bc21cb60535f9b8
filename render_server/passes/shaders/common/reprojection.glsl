// What the last frame saw of a surface that this frame sees. Needs geometry.glsl.
#include "common/earlier_picture.glsl"
uniform sampler2D last_position;        // world m; w: depth, 0 unknown
uniform mat4 last_camera_from_world;
#pragma switch bool has_history
uniform float pixel_size;               // m at 1 m depth
uniform int turns;
uniform int turn;

const float OFF_PLANE = 4.0;            // pixels at the surface's depth that it may lie off this pixel's plane,
const float PIXELS_APART = 8.0;         // or away from this pixel's point
const float LEAST_WEIGHT = 0.25;
const int TURN_TILE = 8;                // texels
const uint STALE_REAL = 1u, STALE_OBJECT = 2u;   // of a texel: where light must be computed

vec2 last_pixel(vec3 p) { return earlier_pixel(last_camera_from_world, p); }

float bilinear(vec2 at, int j) {
    vec2 f = fract(at);
    return ((j & 1) == 1 ? f.x : 1.0 - f.x) * ((j >> 1) == 1 ? f.y : 1.0 - f.y);
}

// Whether a point that is `away` (m) from another, at a depth, is on the plane there, and less than `pixels` at that depth from it.
bool is_same_surface(vec3 away, float depth, vec3 normal, float pixels) {
    float size = pixel_size * depth;
    return abs(dot(away, normal)) < OFF_PLANE * size && dot(away, away) < pixels * pixels * size * size;
}

// 1 if the pixel of the last picture saw the plane of (position, normal) near that point, else 0.
float same_surface(ivec2 pixel, vec4 position, vec3 normal) {
    if (any(lessThan(pixel, ivec2(0))) || any(greaterThanEqual(pixel, textureSize(last_position, 0)))) return 0.0;
    vec4 seen = texelFetch(last_position, pixel, 0);
    return seen.w > 0.0 && is_same_surface(seen.xyz - position.xyz, position.w, normal, PIXELS_APART) ? 1.0 : 0.0;
}

// Whether it is the turn of a texel's tile, one in `turns`.
bool is_due(ivec2 texel) {
    ivec2 tile = texel / TURN_TILE;
    return (tile.x + 3 * tile.y) % turns == turn;
}
