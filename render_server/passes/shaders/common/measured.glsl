// Measured materials: Gaussians of the half-vector over a diffuse base (docs/method.md 6.7, scene/gaussian_brdf.py).
// Needs brdf.glsl.
layout(rgba32f) readonly uniform image2D measured_brdfs;   // a row a material

const int RISE_TERMS = 6, COSINES = 16, LOBE_TEXELS = 1 + RISE_TERMS + COSINES;
const float LEAST_VIEW = 1e-3;   // cosine

vec4 measured_base(int row) { return imageLoad(measured_brdfs, ivec2(0, row)); }   // diffuse albedo; number of lobes

ivec2 lobe_place(int row, int lobe) { return ivec2(1 + lobe * LOBE_TEXELS, row); }

// Width of the Gaussian, half-angle of the cone that stands for what it reflects (rad).
vec2 lobe_widths(int row, int lobe) { return imageLoad(measured_brdfs, lobe_place(row, lobe)).xy; }

// The fraction of the light from everywhere that a lobe reflects towards the viewer.
vec3 lobe_albedo_of(int row, int lobe, float n_dot_v) {
    float at = clamp(n_dot_v, 0.0, 1.0) * float(COSINES - 1), low = min(floor(at), float(COSINES - 2));
    ivec2 place = lobe_place(row, lobe) + ivec2(1 + RISE_TERMS + int(low), 0);
    return mix(imageLoad(measured_brdfs, place).rgb, imageLoad(measured_brdfs, place + ivec2(1, 0)).rgb, at - low);
}

vec3 lobes_albedo(int row, float n_dot_v) {
    vec3 sum = vec3(0.0);
    for (int k = 0; k < int(measured_base(row).a); ++k) sum += lobe_albedo_of(row, k, n_dot_v);
    return sum;
}

// What microfacets reflect at that angle: a polynomial of 1 - v.h.
vec3 lobe_weight(int row, int lobe, float v_dot_h) {
    ivec2 place = lobe_place(row, lobe);
    float x = 1.0 - clamp(v_dot_h, 0.0, 1.0);
    vec3 sum = vec3(0.0);
    for (int i = RISE_TERMS; i > 0; --i) sum = sum * x + imageLoad(measured_brdfs, place + ivec2(i, 0)).rgb;
    return max(sum, vec3(0.0));
}

// Density of half-vectors, 1/sr. `off`: 1 - n.h.
float half_vector_density(float off, float variance) {
    return exp(-off / variance) / (2.0 * PI * variance * (1.0 - exp(-1.0 / variance)));
}

// BRDF times cosine for a light seen under half-angle `radius` (rad): as a disc it has the variance radius^2 / 4 an axis, a
// quarter of that in half-vectors. The lobe widens by it and keeps its energy.
vec3 measured_times_cosine(int row, vec3 normal, vec3 v, vec3 l, float radius) {
    vec3 n = normalize(normal), h = l + v;
    h *= inversesqrt(max(dot(h, h), 1e-12));
    float n_dot_l = max(dot(n, l), 0.0), n_dot_v = max(dot(n, v), LEAST_VIEW), v_dot_h = max(dot(v, h), LEAST_VIEW);
    float off = 0.5 * dot(n - h, n - h);   // no difference of nearly equal numbers, as 1 - n.h would be
    float beneath = 4.0 * v_dot_h * max(n_dot_l, n_dot_v);
    vec4 base = measured_base(row);
    vec3 sum = base.rgb / PI;
    for (int k = 0; k < int(base.a); ++k) {
        float sigma = lobe_widths(row, k).x;
        sum += lobe_weight(row, k, v_dot_h) * (half_vector_density(off, sigma * sigma + radius * radius / 16.0) / beneath);
    }
    return sum * n_dot_l;
}
