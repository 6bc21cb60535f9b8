// Irradiance of caustic beams: the sharp part per pixel, then the smooth part per texel of the reduced grid. Each
// entry holds that of the real surface and that of the object.
layout(std430) buffer CausticSums { int caustic_sums[]; };   // CAUSTIC_SUMS per entry

const int REAL_LAYER = 0, OBJECT_LAYER = 3, CAUSTIC_SUMS = 6;
const float CAUSTIC_STEPS = 1048576.0;   // 2^20 steps: sums of many small parts up to 2047 camera units

int sums_of_pixel(ivec2 pixel, ivec2 size) { return (pixel.y * size.x + pixel.x) * CAUSTIC_SUMS; }

int sums_of_texel(ivec2 texel, ivec2 grid, ivec2 size) { return (size.x * size.y + texel.y * grid.x + texel.x) * CAUSTIC_SUMS; }

vec3 caustic_at(int at) { return vec3(caustic_sums[at], caustic_sums[at + 1], caustic_sums[at + 2]) / CAUSTIC_STEPS; }
