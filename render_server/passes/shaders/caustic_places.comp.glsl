// Where each beam may light the picture.
#include "common/geometry.glsl"
#include "common/walk.glsl"
#define FINDS_PLACES
#include "common/beam_footprint.glsl"
#include "common/camera.glsl"

layout(local_size_x = 64) in;
uniform ivec2 picture_pixels;
uniform int scale;

const float LEAST_SLANT = 1.5;     // around corners too
// Footprints with a radius of this many texels of the reduced grid go there: a standard deviation is then a texel, and the grid holds
// a normal distribution.
const float SMOOTH_TEXELS = FOOTPRINT_CUT;

// Slant of the surface that the beam hits: length of the footprint relative to the beam's width.
float slant_at(Beam beam, int layer, vec2 centre) {
    vec3 normal;
    position_on(layer, clamp(ivec2(round(centre)), ivec2(0), picture_pixels - 1), normal);
    return clamp(-1.0 / min(dot(normal, beam.direction.xyz), -1e-3), LEAST_SLANT, LONGEST);
}

BeamPlace place_of(Beam beam) {
    vec3 c = (camera_from_world * vec4(beam.from.xyz + beam.from.w * beam.direction.xyz, 1.0)).xyz;
    if (c.z <= 0.0) return BeamPlace(ivec2(0), ivec2(-1), -1, 0);
    int layer = beam.flux.w > 0.5 ? OBJECT_LAYER : REAL_LAYER;
    vec2 centre = camera_pinhole.xy * c.xy / c.z + camera_pinhole.zw;
    float radius = camera_pinhole.x * beam.direction.w / c.z;
    bool sharp = radius <= SMOOTH_TEXELS * float(scale);
    int unit = sharp ? 1 : scale;
    ivec2 last = (picture_pixels + unit - 1) / unit - 1;
    float extent = slant_at(beam, layer, centre) * radius;
    ivec2 low = max(ivec2(floor((centre - extent) / float(unit))), ivec2(0));
    ivec2 high = min(ivec2(ceil((centre + extent) / float(unit))), last);
    if (any(greaterThan(low, high))) return BeamPlace(ivec2(0), ivec2(-1), -1, 0);   // nowhere
    return BeamPlace(low, high, layer, sharp ? 1 : 0);
}

void main() {
    uint count = beams_held();
    for (uint i = first_item(); i < count; i += items_apart()) put_place(i, place_of(beam_at(i)));
}
