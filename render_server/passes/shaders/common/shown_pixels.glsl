// A list of pixels that show an object: software renderers compute for all lanes of a vector what one of them needs, so
// passes over the objects walk this. What fills it defines APPENDS_PIXELS.
#ifdef APPENDS_PIXELS
layout(std430) buffer ShownPixels { uint shown_count; uint shown_pixels[]; };

// The place of the first of `count` pixels that are appended in a row.
uint room_for_pixels(uint count) { return atomicAdd(shown_count, count); }

uint packed_pixel(ivec2 pixel) { return uint(pixel.y) << 16 | uint(pixel.x); }

void put_pixel(uint place, ivec2 pixel) { shown_pixels[place] = packed_pixel(pixel); }
#else
layout(std430) readonly buffer ShownPixels { uint shown_count; uint shown_pixels[]; };

uint pixels_shown() { return min(shown_count, uint(shown_pixels.length())); }

ivec2 shown_pixel(uint i) { return ivec2(int(shown_pixels[i] & 0xffffu), int(shown_pixels[i] >> 16)); }
#endif
