// Footprints of beams in the picture, and the sums of their light. Needs geometry.glsl.
#include "common/basis.glsl"
#include "common/beams.glsl"
#include "common/caustic_sums.glsl"

// Where a beam may light the picture: the first and last column and row, of pixels if `sharp`, else of texels of the
// reduced grid. `layer`: REAL_LAYER or OBJECT_LAYER, -1 nowhere.
struct BeamPlace { ivec2 low; ivec2 high; int layer; int sharp; };

// Two texels a beam: low and high, layer and sharp.
#ifdef FINDS_PLACES
layout(rgba16i) writeonly uniform iimage2D beam_places;

void put_place(uint i, BeamPlace place) {
    ivec2 at = texel_of_beam(i, 2);
    imageStore(beam_places, at, ivec4(place.low, place.high));
    imageStore(beam_places, at + ivec2(1, 0), ivec4(place.layer, place.sharp, 0, 0));
}
#else
layout(rgba16i) readonly uniform iimage2D beam_places;

ivec4 bounds_of_beam(uint i) { return imageLoad(beam_places, texel_of_beam(i, 2)); }

BeamPlace place_of_beam(uint i) {
    ivec4 bounds = bounds_of_beam(i), kind = imageLoad(beam_places, texel_of_beam(i, 2) + ivec2(1, 0));
    return BeamPlace(bounds.xy, bounds.zw, kind.x, kind.y);
}
#endif

const float LONGEST = 4.0;   // limit of a slanted footprint, in radii of the beam

vec3 position_on(int layer, ivec2 pixel, out vec3 normal) {
    ivec2 raster = raster_texel(pixel);
    vec4 real = texelFetch(real_surface_position, pixel, 0), object = texelFetch(virtual_raster_position, raster, 0);
    normal = layer == REAL_LAYER ? texelFetch(real_surface_normal, pixel, 0).xyz : texelFetch(virtual_raster_normal, raster, 0).xyz;
    return (layer == REAL_LAYER ? real.w > 0.0 : object.w > 0.0) ? (layer == REAL_LAYER ? real.xyz : object.xyz) : vec3(1e9);
}

const float ROUNDING = 1e-4;   // m, and of a ball's radius

// Whether a beam may light any surface in a ball (middle, radius; world m): caustic_part leaves out the rest.
bool may_light(Beam beam, vec4 ball) {
    vec3 to = ball.xyz - beam.from.xyz;
    float along = dot(to, beam.direction.xyz), radius = ball.w * (1.0 + ROUNDING) + ROUNDING;
    float aside = length(to - along * beam.direction.xyz);
    return aside <= beam.direction.w + radius && abs(along - beam.from.w) <= LONGEST * beam.direction.w + radius;
}

// Irradiance at (p, normal) in CAUSTIC_STEPS.
ivec3 caustic_part(Beam beam, mat3 basis, vec3 p, vec3 normal) {
    vec3 away = (p - beam.from.xyz) * basis;
    // Behind the start lies, of objects, what the beam leaves; real surfaces go on there, just below an object's foot.
    bool behind = away.z <= 0.0 && beam.flux.a > 0.0;
    if (abs(away.z - beam.from.w) > LONGEST * beam.direction.w || behind) return ivec3(0);
    float cosine = -dot(normal, beam.direction.xyz);
    float x2 = beam.inverse_variance.x * away.x * away.x + 2.0 * beam.inverse_variance.y * away.x * away.y + beam.inverse_variance.z * away.y * away.y;
    if (cosine <= 0.0 || x2 > FOOTPRINT_CUT * FOOTPRINT_CUT) return ivec3(0);
    vec3 irradiance = beam.flux.rgb * (cosine * beam.inverse_variance.w * exp(-0.5 * x2));
    return ivec3(round(irradiance * CAUSTIC_STEPS));
}
