// Soft mattes of real things before objects: hair, fur, fingers, which depth does not resolve. Of each listed pixel,
// samples of thing and background are taken along rays in all directions, turned from pixel to pixel (Gastal and
// Oliveira 2010), where depth is certain: well inside the thing, and beyond reach of it. Both are normal distributions
// F, B of linear colour. The pixel's colour is a F + (1 - a) B + noise, as in Bayesian matting (Chuang et al. 2001), but F
// and B are integrated out in place of being chosen, which is a normal distribution again:
//     C | a ~ N(a mean F + (1 - a) mean B, a^2 cov F + (1 - a)^2 cov B + noise).
// A third each is the prior of a = 0, a = 1, and all between.
#include "common/edge_sides.glsl"
#include "common/matting_band.glsl"
#include "common/work_list.glsl"

layout(local_size_x = 64) in;
uniform float sight;        // pixels, length of the rays
// rg: mean and variance of the thing's fraction; b: 1, where colours tell it. rgb: the thing's colour minus the
// background's. a of both: where the nearest sample of the thing is, in pixels.
layout(rgba16f) writeonly uniform image2D estimate_out;
layout(rgba16f) writeonly uniform image2D contrast_out;

const int RAYS = 12;
const float STEP = 3.0;    // pixels from sample to sample along a ray; farther on, GROWTH of the way so far
const float GROWTH = 0.125;
const int TAKEN = 4;       // samples of either kind along a ray, the nearest
const int FRACTIONS = 17;  // at which the posterior is evaluated
const float END_PRIOR = float(FRACTIONS - 2);   // of the fractions 0 and 1 each, where that of the others is 1
const float TURN = 6.28318530718 / float(RAYS);

// Samples along one ray.
void look_along(ivec2 pixel, float z, vec3 ray, vec2 direction, inout Side front, inout Side back) {
    int fronts = 0, backs = 0;
    for (float t = STEP; t <= sight && min(fronts, backs) < TAKEN; t += max(STEP, GROWTH * t)) {
        ivec2 offset = ivec2(round(t * direction)), at = pixel + offset;
        if (!in_picture(at)) return;
        float real = texelFetch(real_surface_position, at, 0).w;
        if (real <= 0.0) continue;
        if (real >= occluding_depth(z)) {
            if (backs < TAKEN && !near_front(at, z)) { add(back, pixel, offset, ray); ++backs; }
        } else if (fronts < TAKEN && inside_front(at, z)) { add(front, pixel, offset, ray); ++fronts; }
    }
}

void look_around(ivec2 pixel, float z, out Side front, out Side back) {
    front = back = no_side();
    vec3 ray = ray_of(pixel);
    float phase = float((pixel.x & 1) + 2 * (pixel.y & 1)) / 4.0;
    for (int i = 0; i < RAYS; ++i) {
        float angle = (float(i) + phase) * TURN;
        look_along(pixel, z, ray, vec2(cos(angle), sin(angle)), front, back);
    }
    finish(front);
    finish(back);
}

// A pivot of Cholesky's decomposition. It is at least the noise in exact arithmetic (both covariances are positive
// semidefinite), so that bounding it keeps rounding from a root of nothing or less.
float root(float pivot) { return sqrt(max(pivot, NOISE)); }

// xyz: s^-1 d; w: half of the logarithm of the determinant of s. By Cholesky's decomposition, because s may be nearly singular.
vec4 solved(mat3 s, vec3 d) {
    float l00 = root(s[0][0]), l10 = s[0][1] / l00, l20 = s[0][2] / l00;
    float l11 = root(s[1][1] - l10 * l10), l21 = (s[1][2] - l20 * l10) / l11;
    float l22 = root(s[2][2] - l20 * l20 - l21 * l21);
    float y0 = d.x / l00, y1 = (d.y - l10 * y0) / l11, y2 = (d.z - l20 * y0 - l21 * y1) / l22;
    float x2 = y2 / l22, x1 = (y1 - l21 * x2) / l11, x0 = (y0 - l10 * x1 - l20 * x2) / l00;
    return vec4(x0, x1, x2, log(l00 * l11 * l22));
}

mat3 covariance(float a, Side front, Side back) {
    return a * a * front.squares + (1.0 - a) * (1.0 - a) * back.squares + NOISE * mat3(1.0);
}

// The logarithm of the likelihood of a fraction.
float log_likelihood(float a, vec3 colour, Side front, Side back) {
    vec3 d = colour - mix(back.colour, front.colour, a);
    vec4 x = solved(covariance(a, front, back), d);
    return -0.5 * dot(d, x.xyz) - x.w;
}

// Mean and variance of the thing's fraction by its posterior. The moments are kept relative to the greatest
// likelihood so far.
vec2 posterior(vec3 colour, Side front, Side back) {
    float greatest = log_likelihood(0.0, colour, front, back);
    vec3 sum = vec3(END_PRIOR, 0.0, 0.0);
    for (int i = 1; i < FRACTIONS; ++i) {
        float a = float(i) / float(FRACTIONS - 1), found = log_likelihood(a, colour, front, back);
        float prior = i < FRACTIONS - 1 ? 1.0 : END_PRIOR;
        sum = sum * exp(min(greatest - found, 0.0)) + prior * exp(min(found - greatest, 0.0)) * vec3(1.0, a, a * a);
        greatest = max(greatest, found);
    }
    float mean = sum.y / sum.x;
    return vec2(mean, max(sum.z / sum.x - mean * mean, 0.0));
}

// The pixel's own F - B, given its colour and fraction.
vec3 contrast(vec3 colour, float a, Side front, Side back) {
    vec3 x = solved(covariance(a, front, back), colour - mix(back.colour, front.colour, a)).xyz;
    vec3 own_front = front.colour + a * (front.squares * x), own_back = back.colour + (1.0 - a) * (back.squares * x);
    return max(own_front, vec3(0.0)) - max(own_back, vec3(0.0));
}

// Stores what the colours tell; matte_fusion.comp.glsl makes a matte of it.
void find_estimate(ivec2 pixel) {
    float z = depth_shown(pixel);
    if (antialiased && covered_fraction(pixel, z) <= 0.0) return;
    Side front, back;
    look_around(pixel, z, front, back);
    if (!has_step(front, back, z)) return;
    vec3 colour = texelFetch(linear_picture, pixel, 0).rgb;
    vec2 found = posterior(colour, front, back);
    imageStore(estimate_out, pixel, vec4(found, 1.0, float(front.nearest.x)));
    imageStore(contrast_out, pixel, vec4(contrast(colour, found.x, front, back), float(front.nearest.y)));
}

void main() {
    int width = textureSize(real_surface_position, 0).x;
    for (uint i = first_item(); i < listed_count(); i += items_apart())
        find_estimate(texel_of_index(texels[i], width));
}
