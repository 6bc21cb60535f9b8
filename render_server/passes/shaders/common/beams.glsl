// Caustic beams of smooth virtual surfaces, each with its footprint on the surface that it hits.
struct Beam {
    vec4 from;        // world m; w: distance to the surface that it hits, m
    vec4 direction;   // unit length; w: radius of the footprint across the direction, m
    vec4 flux;        // rgb; w: 0 it hits a real surface, 1 an object
    vec4 inverse_variance;   // of the footprint, in basis_around(direction): xx, xy, yy (1/m^2);
                             // w: density on the axis (1/m^2)
};
const int BEAMS_A_ROW = 256;   // of images, four texels a beam: software renderers load buffers lane by lane

ivec2 texel_of_beam(uint i, int texels) { return ivec2(int(i) % BEAMS_A_ROW * texels, int(i) / BEAMS_A_ROW); }

#ifdef APPENDS_BEAMS
layout(std430) buffer BeamCount { uint beam_count; };
layout(rgba32f) writeonly uniform image2D beam_texels;

// Its number; there is room for all that are sent.
uint append_beam(Beam beam) {
    uint i = atomicAdd(beam_count, 1u);
    ivec2 at = texel_of_beam(i, 4);
    if (at.y >= imageSize(beam_texels).y) return i;
    imageStore(beam_texels, at, beam.from);
    imageStore(beam_texels, at + ivec2(1, 0), beam.direction);
    imageStore(beam_texels, at + ivec2(2, 0), beam.flux);
    imageStore(beam_texels, at + ivec2(3, 0), beam.inverse_variance);
    return i;
}
#else
layout(std430) readonly buffer BeamCount { uint beam_count; };
layout(rgba32f) readonly uniform image2D beam_texels;

uint beams_held() { return min(beam_count, uint(imageSize(beam_texels).y * BEAMS_A_ROW)); }

Beam beam_at(uint i) {
    ivec2 at = texel_of_beam(i, 4);
    return Beam(imageLoad(beam_texels, at), imageLoad(beam_texels, at + ivec2(1, 0)), imageLoad(beam_texels, at + ivec2(2, 0)),
        imageLoad(beam_texels, at + ivec2(3, 0)));
}
#endif

// A footprint is a normal distribution, cut off at this many standard deviations.
const float FOOTPRINT_CUT = 3.0;
const float FOOTPRINT_FRACTION = 0.98889;   // fraction of its energy within the cut: 1 - exp(-cut^2 / 2)
