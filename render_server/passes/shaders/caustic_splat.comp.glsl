// Adds the irradiance of narrow beams to the pixels around their hits; a workgroup per beam. Sums are integers, so that
// their order does not matter.
#include "common/geometry.glsl"
#define ADDS_CAUSTICS
#include "common/beam_footprint.glsl"
#include "common/camera.glsl"

layout(local_size_x = 64) in;
uniform ivec2 picture_pixels;

void splat(Beam beam, BeamPlace place) {
    mat3 basis = basis_around(beam.direction.xyz);
    ivec2 size = place.high - place.low + 1;
    for (int i = int(gl_LocalInvocationIndex); i < size.x * size.y; i += 64) {
        ivec2 pixel = place.low + ivec2(i % size.x, i / size.x);
        vec3 normal, p = position_on(place.layer, pixel, normal);
        ivec3 part = caustic_part(beam, basis, p, normal);
        int at = sums_of_pixel(pixel, picture_pixels) + place.layer;
        for (int j = 0; j < 3; ++j)
            if (part[j] != 0) atomicAdd(caustic_sums[at + j], part[j]);
    }
}

void main() {
    uint count = beams_held();
    for (uint i = gl_WorkGroupID.x; i < count; i += gl_NumWorkGroups.x) {
        BeamPlace place = place_of_beam(i);
        if (place.layer >= 0 && place.sharp != 0) splat(beam_at(i), place);
    }
}
