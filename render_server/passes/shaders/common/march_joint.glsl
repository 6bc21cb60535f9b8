// Cone marching of [P1] 3.2: front-to-back through one mipmap whose opacity is the joint one (V_eta),
//   c += (1 - a) c_v,  a += (1 - a) a_v        (c_v premultiplied; the factor a_0 before c_0 in eq. 5 is a slip).
// A step is the edge of the sampled cell, as in the paper, so opacity needs no correction for it (docs/method.md 4.5).
#include "common/volume.glsl"

const float OPAQUE = 0.99;   // opacity that ends a march

// Premultiplied (c, a) seen by a cone along d. One-sided mipmaps are sampled for both sides: a cone that starts
// inside an object is blocked by its far wall.
vec4 cone_sample(sampler3D mipmap, vec3 q, int level, vec3 d) {
#if DIRECTIONS == 1
    return volume_sample(mipmap, volume * volume_size, volume_size, q, level, 0);
#else
    vec4 sum = vec4(0.0);
    int first = volume * volume_size;
    for (int k = 0; k < DIRECTIONS; ++k) sum += abs(d[k >> 1]) * volume_sample(mipmap, first, volume_size, q, level, k);
    return sum;
#endif
}

// Takes one step. Directional cells hold the covered fraction of their face, which adds up to 1 across a surface
// however it lies between the samples (march.glsl); the marker of isotropic ones is composited as in the paper.
vec4 accumulated(vec4 sum, vec4 v) {
    float room = 1.0 - sum.a;
#if DIRECTIONS == 1
    return sum + room * v;
#else
    return sum + v * (v.a > room ? room / v.a : 1.0);
#endif
}

// (c, a) of the cone from q (voxels) along d within `interval`; `ratio` = diameter / distance.
vec4 march(sampler3D mipmap, vec3 q, vec3 d, float ratio, vec2 interval) {
    vec4 sum = vec4(0.0);
    float t = interval.x;
    if (t < interval.y) do {   // at least a cell a step; a loop that tests at its end: walk.glsl
        float diameter = max(1.0, ratio * t);
        int level = min(int(floor(log2(diameter) + 0.5)), volume_levels - 1);
        float edge = exp2(float(level));
        sum = accumulated(sum, cone_sample(mipmap, q + (t + 0.5 * edge) * d, level, d));
        t += edge;
    } while (t < interval.y && sum.a < OPAQUE);
    return sum;
}
