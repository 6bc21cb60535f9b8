// GGX microfacet BRDF with the height-correlated Smith term (Walter et al. 2007, Heitz 2014) and Schlick's Fresnel, over a
// diffuse base that gets what the lobe leaves: in even light a white surface shows just that light (docs/method.md 4.7).
// Rounding to half floats makes every other normal longer than 1, so cosines may exceed 1.
#include "common/basis.glsl"

// (1 - cosine)^5 of Schlick's term; pow of a negative number is NaN.
float grazing_weight(float cosine) {
    float x = clamp(1.0 - cosine, 0.0, 1.0);
    return x * x * x * x * x;
}

float ggx_distribution(float n_dot_h, float alpha) {
    float a2 = alpha * alpha;
    float d = n_dot_h * n_dot_h * (a2 - 1.0) + 1.0;
    return a2 / (PI * d * d);
}

// G / (4 n.l n.v)
float smith_visibility(float n_dot_l, float n_dot_v, float alpha) {
    float a2 = alpha * alpha;
    float lambda_v = n_dot_l * sqrt(n_dot_v * n_dot_v * (1.0 - a2) + a2);
    float lambda_l = n_dot_v * sqrt(n_dot_l * n_dot_l * (1.0 - a2) + a2);
    return 0.5 / max(lambda_v + lambda_l, 1e-6);
}

// Without reflection at normal incidence there is no interface, so none at grazing angles either: a Lambertian
// surface.
bool has_interface(vec3 f0) { return f0 != vec3(0.0); }

vec3 fresnel_schlick(vec3 f0, float cosine) {
    return has_interface(f0) ? f0 + (1.0 - f0) * grazing_weight(cosine) : vec3(0.0);
}

// Fresnel's reflectance for unpolarised light; `eta`: index on this side over the one beyond. 1: total reflection.
float fresnel_dielectric(float cosine, float eta) {
    float sine2 = eta * eta * max(1.0 - cosine * cosine, 0.0);
    if (sine2 >= 1.0) return 1.0;
    float beyond = sqrt(1.0 - sine2);
    float across = (eta * cosine - beyond) / (eta * cosine + beyond);
    float along = (cosine - eta * beyond) / (cosine + eta * beyond);
    return 0.5 * (across * across + along * along);
}

// Directional albedo of the lobe as if every microfacet reflected all light (x) or (1 - cosine)^5 of it (y): rational fits
// in the roots of the cosine and of alpha to the integrals, within 0.012 from cosine 0.05 on.
vec2 lobe_albedo(float roughness, float n_dot_v) {
    float x = sqrt(clamp(n_dot_v, 1e-3, 1.0)), r = roughness;
    float lost = (0.6373 + r * (-1.962 + 1.3035 * r) + x * (-0.0104 + 2.3882 * r - 0.8464 * x))
        / (r * (0.6235 + r * (4.7755 - 1.6819 * r))
            + x * (-0.1492 + r * (-9.6169 + 5.0022 * r) + x * (5.7903 - 0.4948 * r - 2.0802 * x)));
    float grazing = (0.9591 + r * (-1.0615 + r * (0.7896 - 0.3781 * r))
            + x * (-1.0906 + r * (1.5887 - 0.367 * r) + x * (-1.098 - 0.6203 * r + 1.2425 * x)))
        / (1.0 + r * (0.3065 + 9.8252 * r) + x * (-1.5368 - 6.7215 * r + 4.1183 * x));
    float whole = min(1.0 - r * r * lost, 1.0);
    return vec2(whole, clamp(grazing, 0.0, whole));
}

// The means of both over light from everywhere.
vec2 mean_lobe_albedo(float roughness) {
    float r = roughness;
    return vec2(0.9993 + r * (0.0054 + r * (0.2549 + r * (-2.0969 + 1.2481 * r))),
        0.0469 + r * (0.0424 + r * (-0.419 + r * (0.5563 - 0.2242 * r))));
}

// Light that microfacets throw at each other leaves the surface after all: a gain of the lobe that single reflection lacks
// (Turquin 2019). `whole`: lobe_albedo's x.
vec3 further_reflections(vec3 f0, float whole) { return 1.0 + f0 * (1.0 / whole - 1.0); }

vec3 reflectance_of(vec3 f0, vec2 lobe) {
    vec3 all = (f0 * (lobe.x - lobe.y) + lobe.y) * further_reflections(f0, lobe.x);
    return has_interface(f0) ? min(all, vec3(1.0)) : vec3(0.0);
}

// Directional albedo of the specular lobe for uniform light.
vec3 specular_reflectance(vec3 f0, float roughness, float n_dot_v) {
    return reflectance_of(f0, lobe_albedo(roughness, n_dot_v));
}

// Its mean: the lobe's part of what a surface reflects of light from everywhere, in all directions.
vec3 mean_specular_reflectance(vec3 f0, float roughness) { return reflectance_of(f0, mean_lobe_albedo(roughness)); }

// Of all light, the part that the diffuse base reflects, of albedo `diffuse`.
vec3 mean_diffuse_reflectance(vec3 diffuse, vec3 f0, float roughness) {
    return diffuse * (1.0 - mean_specular_reflectance(f0, roughness));
}

// Diffuse reflection relative to Lambert's: what the lobe leaves of the light on its way in and out (Kelemen and
// Szirmay-Kalos 2001). For light from everywhere it is 1 - specular_reflectance towards the viewer.
vec3 diffuse_under_lobe(vec3 f0, float roughness, float n_dot_l, float n_dot_v) {
    vec3 in_and_out = (1.0 - specular_reflectance(f0, roughness, n_dot_l))
        * (1.0 - specular_reflectance(f0, roughness, n_dot_v));
    return in_and_out / max(1.0 - mean_specular_reflectance(f0, roughness), vec3(1e-3));
}

// Fraction of the lobe of `alpha` around the mirrored direction d that a disc of half-angle `radius` around l fills. In s, the tangent of
// half the angle to d, the lobe is alpha^2 / (PI (alpha^2 + s^2)^2): even light on a sphere, projected stereographically. Of that sphere
// the disc is a cap.
float lobe_in_disc(vec3 d, vec3 l, float alpha, float radius) {
    vec3 sum = d + l, difference = d - l;
    float s2 = dot(difference, difference) / max(dot(sum, sum), 1e-6), r = tan(0.5 * radius);
    float beyond = alpha * alpha + s2 - r * r, cross_term = 4.0 * r * r * alpha * alpha;
    float root = sqrt(beyond * beyond + cross_term), less = 0.5 * cross_term / (root * (root + abs(beyond)));   // without cancellation
    return beyond > 0.0 ? less : 1.0 - less;
}

// The same relative to the irradiance across the beam of a disc of radiance 1.
float image_of_disc(vec3 d, vec3 l, float alpha, float radius) {
    float r = max(radius, 1e-3), sine = sin(r);
    return lobe_in_disc(d, l, alpha, r) / (PI * sine * sine);
}

// Mean of ggx_distribution over the half-vectors towards the points of a disc, seen from within a pixel (`spread`: see below). In s, the
// tangent of the angle to the normal, the lobe is alpha^2 / (PI (alpha^2 + s^2)^2) but for the cosine's fourth power, and the light a disc
// of (spread.x / 2)^2 / l.h, squared radius. Over a disc the lobe's integral has a closed form.
float ggx_over_disc(float n_dot_h, float l_dot_h, float alpha, vec2 spread) {
    float half_disc = tan(0.5 * spread.x), disc2 = half_disc * half_disc / max(l_dot_h, 1e-2) + spread.y * spread.y;
    float a2 = alpha * alpha, cosine2 = max(n_dot_h * n_dot_h, 1e-6);
    float beyond = a2 + (1.0 - cosine2) / cosine2 - disc2, root = sqrt(beyond * beyond + 4.0 * a2 * disc2);
    return 2.0 * a2 / (PI * root * (root + beyond) * cosine2 * cosine2);
}

// Specular BRDF times cosine. `spread`: half-angles (rad), x of the light's disc, y of one over which curvature turns the normal within a
// pixel. A lobe wider than the light's disc is averaged over both; a narrower one shows the disc itself.
vec3 specular_times_cosine(vec3 n, vec3 v, vec3 l, vec3 f0, float roughness, vec2 spread) {
    float alpha = max(roughness * roughness, 2e-3);
    float n_dot_l = max(dot(n, l), 0.0);
    float n_dot_v = max(dot(n, v), 1e-3);
    vec3 h = l + v;
    h *= inversesqrt(max(dot(h, h), 1e-12));   // l = -v has no half-vector
    float l_dot_h = max(dot(l, h), 0.0), whole = lobe_albedo(roughness, n_dot_v).x;
    vec3 reflected = fresnel_schlick(f0, l_dot_h) * further_reflections(f0, whole);
    float shown = length(vec2(spread.x, 2.0 * spread.y));   // mirroring doubles the normal's turn
    if (alpha < 0.5 * spread.x) return reflected * (whole * image_of_disc(reflect(-v, n), l, alpha * sqrt(n_dot_v), shown));
    return reflected * (ggx_over_disc(clamp(dot(n, h), 0.0, 1.0), l_dot_h, alpha, spread)
        * smith_visibility(n_dot_l, n_dot_v, alpha) * n_dot_l);
}

// Half-angle (rad) of the cone about the mirror direction that holds 85 % of the GGX lobe's energy: the
// half-vector of D(h)(n.h) has cdf 1 - cos^2/(...) -> tan^2(theta_h) = alpha^2 * u / (1 - u); reflection doubles it.
float specular_half_angle(float roughness) {
    float alpha = roughness * roughness;
    return min(2.0 * atan(alpha * sqrt(0.85 / 0.15)), 0.45 * PI);
}
