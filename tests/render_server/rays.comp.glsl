// Closest hits of given rays, as the passes find them.
#include "common/ray_mesh.glsl"

layout(local_size_x = 64) in;
layout(std430) readonly buffer Rays { vec4 rays[]; };      // origin, direction
layout(std430) writeonly buffer Hits { vec4 hits[]; };     // distance, triangle, barycentric
uniform int count;

void main() {
    int i = int(gl_GlobalInvocationID.x);
    if (i >= count) return;
    MeshHit hit = closest_hit(Ray(rays[2 * i].xyz, rays[2 * i + 1].xyz));
    hits[i] = vec4(hit.distance, float(hit.triangle), hit.place);
}
