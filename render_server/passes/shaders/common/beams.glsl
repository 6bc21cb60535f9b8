// Light that smooth virtual surfaces throw on: a list of beams, each with its footprint where it meets a surface.
struct Beam {
    vec4 from;        // world m; w: m to the surface that it meets
    vec4 direction;   // unit length; w: radius of the footprint across the direction, m
    vec4 flux;        // rgb; w: 0 it meets a real surface, 1 an object
    vec4 across;      // inverse of the footprint's variance in basis_around(direction): xx, xy, yy (1/m^2);
                      // w: density on the axis (1/m^2)
};
#ifdef APPENDS_BEAMS
layout(std430) buffer Beams { uint beam_count; Beam beams[]; };
#else
layout(std430) readonly buffer Beams { uint beam_count; Beam beams[]; };
#endif

// A footprint is a normal distribution, cut off at so many deviations.
const float FOOTPRINT_CUT = 3.0;
const float FOOTPRINT_FRACTION = 0.98889;   // of it that lies within: 1 - exp(-cut^2 / 2)
