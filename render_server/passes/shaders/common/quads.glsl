// Of each quad of 2 x 2 pixels, one that shows an object stands for all. Needs object_coverage.
bool is_covered(ivec2 pixel) {
    return all(lessThan(pixel, textureSize(object_coverage, 0))) && texelFetch(object_coverage, pixel, 0).r > 0.0;
}

// The first pixel of a quad that shows an object; -1 if none does.
ivec2 first_of_quad(ivec2 quad) {
    for (int i = 0; i < 4; ++i) {
        ivec2 pixel = 2 * quad + ivec2(i & 1, i >> 1);
        if (is_covered(pixel)) return pixel;
    }
    return ivec2(-1);
}
