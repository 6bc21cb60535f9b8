// Visibility of the objects' surface at depth z in a pixel: 1 in front of the real surface (within its noise), 0
// behind it. Unknown depth never occludes.
#include "common/geometry.glsl"
uniform float noise_sigma;     // m at 1 m

float in_front(ivec2 pixel, float z) {
    float real = texelFetch(real_surface_position, pixel, 0).w;
    return real > 0.0 && real < z - 3.0 * noise_sigma * z * z ? 0.0 : 1.0;
}
