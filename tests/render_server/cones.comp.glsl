// Fires single cones through the mipmaps (the tests' own shader).
#include "common/march.glsl"

layout(local_size_x = 64) in;
struct Ray { vec4 start; vec4 direction; };   // voxels, cone diameter / distance; unit direction
layout(std430) readonly buffer Rays { Ray rays[]; };
layout(std430) writeonly buffer Results { vec4 results[]; };   // red radiance and transmittance: mu, rho
uniform int ray_count;

void main() {
    int i = int(gl_GlobalInvocationID.x);
    if (i >= ray_count) return;
    March m = march(rays[i].start.xyz, rays[i].direction.xyz, rays[i].start.w, false);
    results[i] = vec4(m.c_mu.r, m.t_mu, m.c_rho.r, m.t_rho);
}
