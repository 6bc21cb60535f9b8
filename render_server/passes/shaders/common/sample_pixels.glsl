// The picture's pixels that a texel of the reduced grid represents (passes/cones.py, LowResGrid).
uniform isampler2D sample_pixels;   // real x, y; virtual x, y; -1: none; below: hidden by objects
#pragma texels rgba16i sample_pixels
