// Cone marching with two transmittances through the same voxels (METHOD 3, exact operator).
//
// Along a ray, a cell of coverage a (seen along k) is crossed a |D_k| times per cell edge; the crossings of one plane
// add up to 1 however the plane lies between the samples. So coverage is summed, and a cone is blocked when the sum
// reaches 1. (Front-to-back products of a one-voxel shell let e^-2 of the light through at any step: no furnace test
// could hold.)
#include "passes/common/volume.glsl"

layout(binding = 2) uniform sampler3D pyramid_mu;
layout(binding = 3) uniform sampler3D pyramid_rho;
layout(std430, binding = 9) readonly buffer Support { int support[6]; };   // voxels where mu and rho differ: min, -max

const float OPAQUE = 0.01;   // transmittance that ends a march
const float STEP = 1.0;      // march step in cell edges of the sampled level

struct March { vec3 c_mu; float t_mu; vec3 c_rho; float t_rho; };

ivec3 facing_slabs(vec3 d) { return ivec3(d.x >= 0.0 ? 0 : 1, d.y >= 0.0 ? 2 : 3, d.z >= 0.0 ? 4 : 5); }

vec4 directional_sample(sampler3D pyramid, vec3 q, int level, ivec3 slabs, vec3 weights) {
    return weights.x * volume_sample(pyramid, q, level, slabs.x)
         + weights.y * volume_sample(pyramid, q, level, slabs.y)
         + weights.z * volume_sample(pyramid, q, level, slabs.z);
}

void accumulate(vec4 crossed, inout vec3 c, inout float t) {
    float taken = crossed.a > t ? t / crossed.a : 1.0;
    c += taken * crossed.rgb;
    t = max(t - taken * crossed.a, 0.0);
}

// Both marches from q (voxels) along d; `ratio` = cone diameter / distance. With `only_rho`, mu is left out.
March march(vec3 q, vec3 d, float ratio, bool only_rho) {
    March m = March(vec3(0.0), 1.0, vec3(0.0), 1.0);
    vec3 weights = abs(d);
    ivec3 slabs = facing_slabs(d);
    vec3 low = vec3(support[0], support[1], support[2]);
    vec3 high = vec3(-support[3], -support[4], -support[5]) + 1.0;
    float t = 0.0;
    for (int i = 0; i < 256; ++i) {
        float diameter = max(1.0, ratio * t);
        int level = min(int(floor(log2(diameter) + 0.5)), volume_levels - 1);
        float edge = exp2(float(level));
        float stride = STEP * edge;
        vec3 at = q + (t + 0.5 * stride) * d;
        if (!inside_volume(at)) break;
        vec4 rho = STEP * directional_sample(pyramid_rho, at, level, slabs, weights);
        if (!only_rho) {
            bool differs = all(greaterThan(at, low - 1.5 * edge)) && all(lessThan(at, high + 1.5 * edge));
            vec4 mu = differs ? STEP * directional_sample(pyramid_mu, at, level, slabs, weights) : rho;
            accumulate(mu, m.c_mu, m.t_mu);
        }
        accumulate(rho, m.c_rho, m.t_rho);
        if (max(only_rho ? 0.0 : m.t_mu, m.t_rho) < OPAQUE) break;
        t += stride;
    }
    return m;
}
