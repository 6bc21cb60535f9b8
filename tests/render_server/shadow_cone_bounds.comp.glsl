// Whether shadow cones of points meet the objects, and whether their bound says that those of a sphere around them may.
#include "common/volume.glsl"
#include "common/shadow_cone.glsl"

layout(local_size_x = 64) in;
layout(std430) readonly buffer Spheres { vec4 spheres[]; };    // middle and radius, m
layout(std430) readonly buffer Points { vec4 points[]; };      // POINTS of each: place and normal
layout(std430) writeonly buffer Found { ivec2 found[]; };      // of the sphere, and how many points
uniform int count;

void main() {
    int i = int(gl_GlobalInvocationID.x);
    if (i >= count) return;
    int met = 0;
    for (int k = POINTS * i; k < POINTS * (i + 1); ++k) met += int(object_meets_cone(points[2 * k].xyz, points[2 * k + 1].xyz));
    found[i] = ivec2(object_meets_cone_of_sphere(spheres[i].xyz, spheres[i].w), met);
}
