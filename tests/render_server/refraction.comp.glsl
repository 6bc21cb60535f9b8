// Fresnel's reflectance of a surface from its cosine and relative index of refraction.
#include "common/brdf.glsl"

layout(local_size_x = 64) in;
layout(std430) readonly buffer Surfaces { vec2 surfaces[]; };   // cosine; index on this side over the one beyond
layout(std430) writeonly buffer Found { float found[]; };
uniform int count;

void main() {
    int i = int(gl_GlobalInvocationID.x);
    if (i < count) found[i] = fresnel_dielectric(surfaces[i].x, surfaces[i].y);
}
