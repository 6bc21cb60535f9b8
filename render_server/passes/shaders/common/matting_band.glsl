// Where the matte of real things is unknown (matting_band.comp.glsl, matting.comp.glsl): at objects' pixels within reach
// of a real surface in front, except well inside of that.
#include "common/shown_object.glsl"
uniform sampler2D nearest_depth;   // least real depth within reach, a texel a block (nearest_depth.comp.glsl)

const int INSIDE = 2;   // pixels from an edge of depth within which it may be wrong, as in object_coverage.comp.glsl

bool in_picture(ivec2 at) {
    return all(greaterThanEqual(at, ivec2(0))) && all(lessThan(at, textureSize(real_surface_position, 0)));
}

// Whether a real surface in front of depth z is within reach.
bool near_front(ivec2 at, float z) {
    float nearest = texelFetch(nearest_depth, at / BLOCK, 0).r;
    return nearest > 0.0 && nearest < occluding_depth(z);
}

// Whether the pixel and those INSIDE pixels from it on all sides show real surfaces in front of depth z.
bool inside_front(ivec2 at, float z) {
    for (int i = 0; i < 9; ++i) {
        ivec2 around = at + INSIDE * (ivec2(i % 3, i / 3) - 1);
        if (in_picture(around) && in_front(around, z) > 0.0) return false;
    }
    return true;
}
