// Pixels that mix a real thing before an object with the old background: what is known of both sides around one, and
// what is stored of it once its fraction is found (edge_unmixing.comp.glsl, matting.comp.glsl).
#include "common/shown_object.glsl"
layout(r16f) uniform image2D object_coverage;
// rgb: to be added to the colour; a: code of the nearest pixel of the thing (composite.comp.glsl), 0 the pixel itself
layout(rgba16f) writeonly uniform image2D edge_correction;
uniform sampler2D linear_picture;          // with linear sampling
#pragma texels rgba16f linear_picture
#include "common/camera.glsl"

const int LEAST_SAMPLES = 3;   // least number for a spread
const float NOISE = 9e-6;      // variance: 0.003 of sensor white, from rounding to 8 bits and from good sensors
const float UNKNOWN = 1.0 / 12.0;   // variance of a fraction that may be anything between 0 and 1

struct Side { vec3 colour; mat3 squares; vec2 middle; float inverse_depth; float weight; int count; ivec2 nearest; };

Side no_side() { return Side(vec3(0.0), mat3(0.0), vec2(0.0), 0.0, 0.0, 0, ivec2(0)); }

// Ray of a pixel (world, 1 m deep).
vec3 ray_of(ivec2 pixel) {
    return mat3(world_from_camera) * vec3(texelFetch(picture_rays, pixel, 0).xy, 1.0);
}

// Inverse depth at which the plane of the real surface at a pixel meets a ray.
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

// Whether both exist and do not continue each other at the pixel, as the floor under an object does.
bool has_step(Side front, Side back, float z) {
    if (min(front.count, back.count) < LEAST_SAMPLES) return false;
    float least = 6.0 * noise_sigma + STEEPEST / (camera_pinhole.x * z);
    return front.inverse_depth > 1.0 / z && front.inverse_depth - back.inverse_depth > least;
}

// A fraction and its variance. Within a standard deviation of 0 or 1 it is 0 or 1, and others are moved apart by as much.
vec2 settled(float a, float variance) {
    float deviation = min(sqrt(variance), 0.45);
    return vec2(clamp((a - deviation) / (1.0 - 2.0 * deviation), 0.0, 1.0), variance);
}

// The thing's fraction of the pixel, `a`: by colour, found with mean and variance `by_colour`, else by the coverage so
// far; `known` is the weight of the former.
float combined_fraction(ivec2 pixel, float covered, vec2 by_colour, out float known) {
    float doubt = by_colour.y / UNKNOWN;
    known = 1.0 / (1.0 + doubt * doubt);
    return mix(1.0 - min(imageLoad(object_coverage, pixel).r / covered, 1.0), by_colour.x, known);
}

// Stores the coverage of an object that covers `covered` of the pixel without the thing, and how to remove the
// background from its colour. `contrast`: the thing's colour minus the background's; `nearest`: offset of the nearest
// pixel of the thing.
void store_edge(ivec2 pixel, float covered, float a, float known, vec3 contrast, ivec2 nearest) {
    float shown = (1.0 - a) * covered;
    imageStore(object_coverage, pixel, vec4(shown));
    if (shown >= 1.0) return;
    // The pixel a F + (1 - a) B minus the fraction `shown` of B, renormalised.
    vec3 correction = known * shown * a / (1.0 - shown) * contrast;
    bool own = 2.0 * a < 1.0 - shown;   // the rest is mostly the old background
    own = own || any(greaterThan(abs(nearest), ivec2(SURFACE_REACH)));
    ivec2 offset = nearest + SURFACE_REACH;
    int code = own ? 0 : 1 + offset.y * (2 * SURFACE_REACH + 1) + offset.x;
    imageStore(edge_correction, pixel, vec4(correction, float(code)));
}
