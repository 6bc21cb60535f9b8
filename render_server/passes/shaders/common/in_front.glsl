// Visibility of the objects' surface at depth z in a pixel: 1 in front of the real surface (within its noise), 0
// behind it. Unknown depth never occludes.
#include "common/geometry.glsl"
uniform float noise_sigma;     // m at 1 m

// Depth before which a real surface hides the objects' at depth z.
float occluding_depth(float z) { return z - 3.0 * noise_sigma * z * z; }

bool is_hidden(float real, float z) { return real > 0.0 && real < occluding_depth(z); }

float in_front(ivec2 pixel, float z) { return is_hidden(texelFetch(real_surface_position, pixel, 0).w, z) ? 0.0 : 1.0; }
