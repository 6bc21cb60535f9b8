// The part of the picture that is lit though it may be out of the objects' reach, for estimates of light.
uniform ivec4 lit_area;   // first column and row, width and height

bool is_in_lit_area(ivec2 pixel) {
    ivec2 inside = pixel - lit_area.xy;
    return all(greaterThanEqual(inside, ivec2(0))) && all(lessThan(inside, lit_area.zw));
}
