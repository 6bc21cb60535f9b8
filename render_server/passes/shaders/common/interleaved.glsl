// Numbers that 4 x 4 pixels share out among themselves (Keller & Heidrich 2001).
const int INTERLEAVED = 4;   // pixels an edge

// Sixteenths (x) and quarters (y), at their middles: in any 4 x 4 pixels each sixteenth once, and each quarter once in every four
// successive sixteenths.
vec2 interleaved(ivec2 pixel) {
    int y = pixel.y & 3, x = (pixel.x & 3) ^ y, quarter = (x & 2) | (y & 2) >> 1;
    int sixteenth = (x & 1) << 3 | (y & 1) << 2 | quarter;
    return vec2((float(sixteenth) + 0.5) / 16.0, (float(quarter) + 0.5) / 4.0);
}
