// The rims of real things in front of objects. A pixel there mixes the thing's colour F with that of the old
// background B, and composition must show a F + (1 - a) object. F and B come from pixels nearby that certainly show
// one of them, the fraction a from the position of the pixel's colour on the line between them, in linear colour
// (Porter and Duff 1984; Smith and Blinn 1996). It is weighted by how much more F and B differ than they vary; the
// rest is the fraction by depth. Listed pixels get a new coverage, and in `edge_correction` what removes the old
// background from their colour.
#include "common/shown_object.glsl"
#include "common/work_list.glsl"

layout(local_size_x = 64) in;
layout(r16f) uniform image2D object_coverage;
// rgb: to be added to the colour; a: code of the nearest pixel of F (composite.comp.glsl), 0 the pixel itself
layout(rgba16f) writeonly uniform image2D edge_correction;
uniform sampler2D linear_picture;          // with linear sampling
#include "common/camera.glsl"

// pixels from an edge of depth within which it may be wrong, as the window of object_coverage.comp.glsl; in
// narrowed(), too
const int REACH = 2;
const int SIGHT = RIM_SIGHT;   // pixels within which certain ones are searched
const int SPAN = 2 * (SIGHT + REACH) + 1;
const int LEAST_SAMPLES = 3;   // least number for a spread
const float NOISE = 9e-6;      // variance: 0.003 of sensor white, from rounding to 8 bits and from good sensors
const float UNKNOWN = 1.0 / 12.0;   // variance of a fraction that may be anything between 0 and 1
const float BEND = 0.01;       // variance: along an edge with a radius of 5 pixels the kernel below shifts the fraction by 0.1
const int ALONG = 2;           // pixels each way along the edge, averaged to reduce noise
const float KERNEL[ALONG + 1] = float[](0.375, 0.25, 0.0625);
const float KERNEL_NOISE = 0.2734375;   // sum of the kernel's squares

struct Side { vec3 colour; mat3 squares; vec2 middle; float inverse_depth; float weight; int count; ivec2 nearest; };

// 1 a real surface in front of depth z, 2 one behind it, 0 unknown.
int class_of(ivec2 at, float z, ivec2 size) {
    if (any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, size))) return 0;
    if (texelFetch(real_surface_position, at, 0).w <= 0.0) return 0;
    return in_front(at, z) > 0.0 ? 2 : 1;
}

// Bits whose neighbours within REACH in a row are all set.
uint narrowed(uint row) { return row & (row << 1) & (row >> 1) & (row << 2) & (row >> 2); }

// Inverse depth at which the plane of the real surface at a pixel meets a ray (world, 1 m deep).
float continued(ivec2 at, vec3 ray) {
    vec4 position = texelFetch(real_surface_position, at, 0);
    vec3 normal = texelFetch(real_surface_normal, at, 0).xyz;
    float away = dot(normal, position.xyz - camera_position);
    return abs(away) > 1e-3 * position.w ? dot(normal, ray) / away : 1.0 / position.w;
}

void add(inout Side side, ivec2 pixel, ivec2 offset, vec3 ray) {
    vec3 colour = texelFetch(linear_picture, pixel + offset, 0).rgb;
    float w = 1.0 / float(offset.x * offset.x + offset.y * offset.y);
    ivec2 n = side.nearest;
    if (side.count == 0 || w * float(n.x * n.x + n.y * n.y) > 1.0) side.nearest = offset;
    side.colour += w * colour;
    side.squares += w * outerProduct(colour, colour);
    side.middle += w * vec2(offset);
    side.inverse_depth += w * continued(pixel + offset, ray);
    side.weight += w;
    side.count += 1;
}

void finish(inout Side side) {
    side.colour /= side.weight;
    side.squares = side.squares / side.weight - outerProduct(side.colour, side.colour);
    side.middle /= side.weight;
    side.inverse_depth /= side.weight;
}

// Sums over the pixels within SIGHT whose neighbours within REACH are all of their class.
void look_around(ivec2 pixel, float z, out Side front, out Side back) {
    ivec2 size = textureSize(real_surface_position, 0);
    vec3 ray = mat3(world_from_camera) * vec3(texelFetch(picture_rays, pixel, 0).xy, 1.0);
    front = back = Side(vec3(0.0), mat3(0.0), vec2(0.0), 0.0, 0.0, 0, ivec2(0));
    uvec2 rows[SPAN];
    for (int j = 0; j < SPAN; ++j) {
        uvec2 row = uvec2(0u);
        for (int i = 0; i < SPAN; ++i) {
            int c = class_of(pixel + ivec2(i, j) - SIGHT - REACH, z, size);
            row |= uvec2(c == 1, c == 2) << uint(i);
        }
        rows[j] = uvec2(narrowed(row.x), narrowed(row.y));
    }
    for (int j = REACH; j < SPAN - REACH; ++j) {
        uvec2 row = rows[j - 2] & rows[j - 1] & rows[j] & rows[j + 1] & rows[j + 2];
        for (int i = REACH; i < SPAN - REACH; ++i) {
            ivec2 offset = ivec2(i, j) - SIGHT - REACH;
            if (((row.x >> uint(i)) & 1u) != 0u) add(front, pixel, offset, ray);
            if (((row.y >> uint(i)) & 1u) != 0u) add(back, pixel, offset, ray);
        }
    }
    finish(front);
    finish(back);
}

// Whether both exist and do not continue each other at the pixel, as the floor under an object does.
bool has_step(Side front, Side back, float z) {
    if (min(front.count, back.count) < LEAST_SAMPLES) return false;
    float least = 6.0 * noise_sigma + STEEPEST / (camera_pinhole.x * z);
    return front.inverse_depth > 1.0 / z && front.inverse_depth - back.inverse_depth > least;
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
    float deviation = min(sqrt(variance), 0.45);
    return vec2(clamp((a - deviation) / (1.0 - 2.0 * deviation), 0.0, 1.0), variance);
}

void unmix(ivec2 pixel) {
    float z = depth_shown(pixel);
    Side front, back;
    look_around(pixel, z, front, back);
    if (!has_step(front, back, z)) return;
    float covered = antialiased ? covered_fraction(pixel, z) : 1.0;
    if (covered <= 0.0) return;
    vec2 found = fraction_by_colour(pixel, front, back);
    float doubt = found.y / UNKNOWN, known = 1.0 / (1.0 + doubt * doubt);
    float a = mix(1.0 - min(imageLoad(object_coverage, pixel).r / covered, 1.0), found.x, known);
    float shown = (1.0 - a) * covered;
    imageStore(object_coverage, pixel, vec4(shown));
    if (shown >= 1.0) return;
    // The pixel a F + (1 - a) B minus the fraction `shown` of B, renormalised.
    vec3 correction = known * shown * a / (1.0 - shown) * (front.colour - back.colour);
    bool own = 2.0 * a < 1.0 - shown;   // the rest is mostly the old background
    ivec2 offset = front.nearest + SIGHT;
    imageStore(edge_correction, pixel, vec4(correction, own ? 0.0 : float(1 + offset.y * (2 * SIGHT + 1) + offset.x)));
}

void main() {
    int width = textureSize(real_surface_position, 0).x;
    for (uint i = first_item(); i < listed_count(); i += items_apart())
        unmix(texel_of_index(texels[i], width));
}
