// Marks blocks of BLOCK x BLOCK pixels whose picture differs from its mean over time by more than noise: in a pixel by more than any
// camera's, or on the whole by more than is left when another brightness and a shift (Lucas and Kanade 1981) have explained what they can.
#include "common/pixel_group.glsl"
layout(r8ui) writeonly uniform uimage2D changed_out;   // 1: changed
uniform sampler2D temporal_mean;    // rgb; a: how many pictures it is of, 0 none
uniform sampler2D linear_picture;
#pragma texels rgba16f temporal_mean linear_picture
uniform ivec4 blocks;      // first column and row, width and height
uniform float noise;       // greatest standard deviation of a pixel's colour at 1; it falls with the square root of colour
uniform float sigmas;      // how many of them noise explains

const float DARKEST = 0.01;   // below, noise falls no further
// Of an F test, what each of three unknowns explains relative to what is left of each pixel: noise does so in one block of 100 000.
const float MOST_EXPLAINED = 10.0;
const float LEAST_SQUARE = 1e-6;   // of a change of brightness, a pixel: of no noise

vec3 mean_at(ivec2 at) {
    return texelFetch(temporal_mean, clamp(at, ivec2(0), textureSize(temporal_mean, 0) - 1), 0).rgb;
}

float brightness(vec3 colour) { return dot(colour, vec3(1.0)); }

// Change of brightness over a block: equations of its least squares by a step and the picture's slopes, and the sum of its squares.
struct Change { mat3 equations; vec3 right; float square; };

void add_pixel(ivec2 at, vec3 difference, inout Change sum) {
    float across = brightness(mean_at(at + ivec2(1, 0)) - mean_at(at - ivec2(1, 0)));
    float down = brightness(mean_at(at + ivec2(0, 1)) - mean_at(at - ivec2(0, 1)));
    vec3 row = vec3(1.0, 0.5 * across, 0.5 * down);
    float change = brightness(difference);
    sum.equations += outerProduct(row, row);
    sum.right += change * row;
    sum.square += change * change;
}

bool is_explained_by_noise(Change sum) {
    float count = sum.equations[0][0], least = LEAST_SQUARE * count;
    mat3 equations = sum.equations + mat3(0.0, 0.0, 0.0, 0.0, least, 0.0, 0.0, 0.0, least);
    float explained = dot(sum.right, inverse(equations) * sum.right), left = max(sum.square - explained, least);
    return explained * (count - 3.0) <= MOST_EXPLAINED * 3.0 * left;
}

bool has_changed(ivec2 first, ivec2 end, float n) {
    Change sum = Change(mat3(0.0), vec3(0.0), 0.0);
    for (int y = first.y; y < end.y; ++y)
        for (int x = first.x; x < end.x; ++x) {
            ivec2 at = ivec2(x, y);
            vec3 kept = mean_at(at), difference = texelFetch(linear_picture, at, 0).rgb - kept;
            vec3 limit = sigmas * noise * sqrt((1.0 + 1.0 / n) * max(kept, vec3(DARKEST)));
            if (any(greaterThan(abs(difference), limit))) return true;
            add_pixel(at, difference, sum);
        }
    return !is_explained_by_noise(sum);
}

void main() {
    ivec2 block = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(block, blocks.zw))) return;
    block += blocks.xy;
    ivec2 first = BLOCK * block, end = min(first + BLOCK, textureSize(linear_picture, 0));
    float n = texelFetch(temporal_mean, first, 0).a;
    imageStore(changed_out, block, uvec4(n == 0.0 || has_changed(first, end, n) ? 1u : 0u));
}
