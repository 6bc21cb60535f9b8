// The rims of real things in front of objects. A pixel there mixes the thing's colour F with that of the old
// background B, and composition must show a F + (1 - a) object. F and B come from pixels nearby that certainly show
// one of them, the fraction a from the position of the pixel's colour on the line between them, in linear colour
// (Porter and Duff 1984; Smith and Blinn 1996). It is weighted by how much more F and B differ than they vary; the
// rest is the fraction by depth. Such pixels get a new coverage, and in `edge_correction` what removes the old
// background from their colour.
#include "common/edge_sides.glsl"

// pixels from an edge of depth within which it may be wrong, as the window of object_coverage.comp.glsl; in
// narrowed(), too
const int REACH = 2;
const int SIGHT = RIM_SIGHT;   // pixels within which certain ones are searched
const int SPAN = 2 * (SIGHT + REACH) + 1;
const float BEND = 0.01;       // variance: along an edge with a radius of 5 pixels the kernel below shifts the fraction by 0.1
const int ALONG = 2;           // pixels each way along the edge, averaged to reduce noise
const float KERNEL[ALONG + 1] = float[](0.375, 0.25, 0.0625);
const float KERNEL_NOISE = 0.2734375;   // sum of the kernel's squares

// 1 a real surface in front of depth z, 2 one behind it, 0 unknown.
int class_of(ivec2 at, float z) {
    if (texelFetch(real_surface_position, at, 0).w <= 0.0) return 0;
    return in_front(at, z) > 0.0 ? 2 : 1;
}

// Bits whose neighbours within REACH in a row are all set.
uint narrowed(uint row) { return row & (row << 1) & (row >> 1) & (row << 2) & (row >> 2); }

// The pixels of a row that are in front (x) and behind (y) as those within REACH beside them; bit i is offset
// i - SIGHT - REACH.
uvec2 classes_of_row(ivec2 first, float z, ivec2 size) {
    uvec2 row = uvec2(0u);
    int i = max(-first.x, 0), end = first.y >= 0 && first.y < size.y ? min(SPAN, size.x - first.x) : 0;
    if (i < end) do {   // what is in the picture
        int c = class_of(first + ivec2(i, 0), z);
        row |= uvec2(c == 1, c == 2) << uint(i);
    } while (++i < end);
    return uvec2(narrowed(row.x), narrowed(row.y));
}

// Sums over the pixels within SIGHT whose neighbours within REACH are all of their class. The rows within REACH are
// five variables: an array would make Mesa unroll the loops, which takes seconds to compile.
void look_around(ivec2 pixel, float z, out Side front, out Side back) {
    ivec2 size = textureSize(real_surface_position, 0);
    vec3 ray = ray_of(pixel);
    front = back = no_side();
    uvec2 a = uvec2(0u), b = a, c = a, d = a;
    for (int j = -SIGHT - REACH; j <= SIGHT + REACH; ++j) {
        uvec2 e = classes_of_row(pixel + ivec2(-SIGHT - REACH, j), z, size), row = a & b & c & d & e;
        for (int i = REACH; i < SPAN - REACH; ++i) {
            ivec2 offset = ivec2(i - SIGHT - REACH, j - REACH);
            if (((row.x >> uint(i)) & 1u) != 0u) add(front, pixel, offset, ray);
            if (((row.y >> uint(i)) & 1u) != 0u) add(back, pixel, offset, ray);
        }
        a = b, b = c, c = d, d = e;
    }
    finish(front);
    finish(back);
}

// Mean colour along an edge.
vec3 mean_along(ivec2 pixel, vec2 edge) {
    vec3 sum = vec3(0.0);
    for (int i = -ALONG; i <= ALONG; ++i) {
        vec2 at = (vec2(pixel) + 0.5 + float(i) * edge) / vec2(textureSize(linear_picture, 0));
        sum += KERNEL[abs(i)] * textureLod(linear_picture, at, 0.0).rgb;
    }
    return sum;
}

// The thing's fraction of the pixel by colour, and its variance: the pixel's own combined with the mean along the
// edge, weighted by inverse variance. A colour within the spread of F or B is wholly that one; one beside the line is
// neither.
vec2 fraction_by_colour(ivec2 pixel, Side front, Side back) {
    vec3 d = front.colour - back.colour;
    float length2 = max(dot(d, d), 1e-9);
    vec2 across = back.middle - front.middle;
    vec2 edge = vec2(-across.y, across.x) / max(length(across), 1e-3);
    vec3 colour = texelFetch(linear_picture, pixel, 0).rgb - back.colour, mean = mean_along(pixel, edge) - back.colour;
    float own = dot(colour, d) / length2, along = dot(mean, d) / length2;
    vec3 beside = mean - along * d;
    float spread = max(0.0, max(dot(d, front.squares * d), dot(d, back.squares * d)) / length2);
    float noise = (spread + NOISE) / length2, stray = dot(beside, beside) / length2;
    float variance = noise + stray, smoothed = KERNEL_NOISE * noise + stray + BEND;
    float a = (clamp(own, 0.0, 1.0) * smoothed + clamp(along, 0.0, 1.0) * variance) / (variance + smoothed);
    variance = variance * smoothed / (variance + smoothed);
    return settled(a, variance);
}

void unmix(ivec2 pixel) {
    float z = depth_shown(pixel);
    Side front, back;
    look_around(pixel, z, front, back);
    if (!has_step(front, back, z)) return;
    float covered = antialiased ? covered_fraction(pixel, z) : 1.0;
    if (covered <= 0.0) return;
    vec2 found = fraction_by_colour(pixel, front, back);
    float known, a = combined_fraction(pixel, covered, found, known);
    store_edge(pixel, covered, a, known, front.colour - back.colour, front.nearest);
}
