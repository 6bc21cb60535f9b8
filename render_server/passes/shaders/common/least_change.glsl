// Relative changes of light below this count as none: in an 8-bit sRGB picture they are at most 0.22 of a code.
const float LEAST_CHANGE = 1.0 / 512.0;
