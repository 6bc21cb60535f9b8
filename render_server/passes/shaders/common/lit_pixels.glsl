// The pixels that a texel of the reduced grid lights: with transparent objects also those that objects hide.
#pragma switch TRANSMISSION

// `pixels`: of sample_pixels.
ivec4 lit_pixels(ivec4 pixels) {
#ifdef TRANSMISSION
    if (pixels.x < -1) pixels.xy = -2 - pixels.xy;
#endif
    return pixels;
}
