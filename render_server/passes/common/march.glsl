// Cone marching with two transmittances through the same voxels (METHOD 3, exact operator).
//
// Along a ray, a cell of coverage a (seen along k) is crossed a |D_k| times per cell edge; the crossings of one plane
// add up to 1 however the plane lies between the samples. So coverage is summed, and a cone is blocked when the sum
// reaches 1. (Front-to-back products of a one-voxel shell let e^-2 of the light through at any step: no furnace test
// could hold.)
#include "passes/common/volume.glsl"

layout(binding = 2) uniform sampler3D pyramid_mu;
layout(binding = 3) uniform sampler3D pyramid_rho;
layout(binding = 16) uniform sampler3D pyramid_far;   // real scene beyond the volume, coarse, the same in mu and rho
uniform vec3 far_origin;      // world position of its low corner, m
uniform float far_edge;       // m
uniform int far_size;         // voxels an edge
uniform int far_levels;
layout(std430, binding = 9) readonly buffer Support { int support[6]; };   // voxels where mu and rho differ: min, -max

const float OPAQUE = 0.01;   // transmittance that ends a march
const float STEP = 1.0;      // march step in cell edges of the sampled level

struct March { vec3 c_mu; float t_mu; vec3 c_rho; float t_rho; };

ivec3 facing_slabs(vec3 d) { return ivec3(d.x >= 0.0 ? 0 : 1, d.y >= 0.0 ? 2 : 3, d.z >= 0.0 ? 4 : 5); }

vec4 directional_sample(sampler3D pyramid, int n, vec3 q, int level, ivec3 slabs, vec3 weights) {
    return weights.x * volume_sample(pyramid, n, q, level, slabs.x)
         + weights.y * volume_sample(pyramid, n, q, level, slabs.y)
         + weights.z * volume_sample(pyramid, n, q, level, slabs.z);
}

void accumulate(vec4 crossed, inout vec3 c, inout float t) {
    float taken = crossed.a > t ? t / crossed.a : 1.0;
    c += taken * crossed.rgb;
    t = max(t - taken * crossed.a, 0.0);
}

int level_for(float diameter, int levels) { return clamp(int(floor(log2(max(diameter, 1.0)) + 0.5)), 0, levels - 1); }

bool blocked(March m, bool only_rho) { return max(only_rho ? 0.0 : m.t_mu, m.t_rho) < OPAQUE; }

// Through the volume around the objects, from q (voxels); returns the distance travelled (voxels).
float march_near(vec3 q, vec3 d, float ratio, bool only_rho, inout March m) {
    vec3 weights = abs(d);
    ivec3 slabs = facing_slabs(d);
    vec3 low = vec3(support[0], support[1], support[2]);
    vec3 high = vec3(-support[3], -support[4], -support[5]) + 1.0;
    float t = 0.0;
    for (int i = 0; i < 256; ++i) {
        int level = level_for(ratio * t, volume_levels);
        float edge = exp2(float(level));
        float stride = STEP * edge;
        vec3 at = q + (t + 0.5 * stride) * d;
        if (!inside_volume(at)) break;
        vec4 rho = STEP * directional_sample(pyramid_rho, volume_size, at, level, slabs, weights);
        if (!only_rho) {
            bool differs = all(greaterThan(at, low - 1.5 * edge)) && all(lessThan(at, high + 1.5 * edge));
            vec4 mu = differs ? STEP * directional_sample(pyramid_mu, volume_size, at, level, slabs, weights) : rho;
            accumulate(mu, m.c_mu, m.t_mu);
        }
        accumulate(rho, m.c_rho, m.t_rho);
        if (blocked(m, only_rho)) break;
        t += stride;
    }
    return t;
}

// On through the coarse real scene, from q after a distance t (both in its voxels).
void march_far(vec3 q, vec3 d, float t, float ratio, bool only_rho, inout March m) {
    vec3 weights = abs(d);
    ivec3 slabs = facing_slabs(d);
    float travelled = 0.0;
    for (int i = 0; i < 128; ++i) {
        int level = level_for(ratio * (t + travelled), far_levels);
        float stride = STEP * exp2(float(level));
        vec3 at = q + (travelled + 0.5 * stride) * d;
        if (!inside_cube(at, far_size)) break;
        vec4 real = STEP * directional_sample(pyramid_far, far_size, at, level, slabs, weights);
        if (!only_rho) accumulate(real, m.c_mu, m.t_mu);
        accumulate(real, m.c_rho, m.t_rho);
        if (blocked(m, only_rho)) break;
        travelled += stride;
    }
}

// Both marches from q (voxels) along d; `ratio` = cone diameter / distance. With `only_rho`, mu is left out.
March march(vec3 q, vec3 d, float ratio, bool only_rho) {
    March m = March(vec3(0.0), 1.0, vec3(0.0), 1.0);
    float t = march_near(q, d, ratio, only_rho, m);
    if (far_size > 0 && !blocked(m, only_rho)) {
        float scale = voxel_edge / far_edge;
        vec3 leave = (volume_origin + (q + t * d) * voxel_edge - far_origin) / far_edge;
        // A surface that starts the march outside of the volume must not meet its own coarse voxels.
        float skip = t > 0.0 ? 0.0 : 1.5;
        march_far(leave + skip * d, d, t * scale + skip, ratio, only_rho, m);
    }
    return m;
}
