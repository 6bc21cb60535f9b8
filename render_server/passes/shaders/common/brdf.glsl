// GGX microfacet BRDF with the height-correlated Smith term (Walter et al. 2007, Heitz 2014) and Schlick's Fresnel.
// Rounding to half floats makes every other normal longer than 1, so cosines may exceed 1.
#include "common/basis.glsl"

// (1 - cosine)^5 of Schlick's and Burley's terms; pow of a negative number is NaN.
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

// Directional albedo of the specular lobe for uniform light: scale and offset of f0 (Karis 2014, analytic fit).
vec3 specular_reflectance(vec3 f0, float roughness, float n_dot_v) {
    const vec4 c0 = vec4(-1.0, -0.0275, -0.572, 0.022);
    const vec4 c1 = vec4(1.0, 0.0425, 1.04, -0.04);
    vec4 r = roughness * c0 + c1;
    float a004 = min(r.x * r.x, exp2(-9.28 * n_dot_v)) * r.x + r.y;
    vec2 ab = vec2(-1.04, 1.04) * a004 + r.zw;
    return has_interface(f0) ? f0 * ab.x + ab.y : vec3(0.0);
}

// Diffuse reflection relative to Lambert's, under a rough dielectric interface (Burley 2012). Without an interface
// (f0 = 0) it is Lambert's.
float burley(float n_dot_l, float n_dot_v, float l_dot_v, float roughness) {
    float grazing = roughness * (1.0 + l_dot_v) - 0.5;   // F_D90 - 1; 2 cos^2 of the difference angle is 1 + l.v
    return (1.0 + grazing * grazing_weight(n_dot_l)) * (1.0 + grazing * grazing_weight(n_dot_v));
}

// The same for uniform light: mean of (1 - n.l)^5 over the cosine is 1/21, that of l.v is 2/3 n.v.
float burley_mean(float n_dot_v, float roughness) {
    float grazing = roughness * (1.0 + 2.0 / 3.0 * n_dot_v) - 0.5;
    return (1.0 + grazing / 21.0) * (1.0 + grazing * grazing_weight(n_dot_v));
}

// Specular BRDF times cosine for a light seen under half-angle `radius` (rad). Averaging the lobe's peak over the
// light's disc, of radius/2 in half-vectors, gives a GGX peak of alpha^2 + (radius/2)^2; D stays a normalised
// distribution, so the reflected energy is that of the unwidened lobe.
vec3 specular_times_cosine(vec3 n, vec3 v, vec3 l, vec3 f0, float roughness, float radius) {
    float alpha = max(roughness * roughness, 2e-3);
    float wide = min(sqrt(alpha * alpha + 0.25 * radius * radius), 1.0);
    float n_dot_l = max(dot(n, l), 0.0);
    float n_dot_v = max(dot(n, v), 1e-3);
    vec3 h = l + v;
    h *= inversesqrt(max(dot(h, h), 1e-12));   // l = -v has no half-vector
    return fresnel_schlick(f0, max(dot(l, h), 0.0)) * (ggx_distribution(clamp(dot(n, h), 0.0, 1.0), wide)
        * smith_visibility(n_dot_l, n_dot_v, alpha) * n_dot_l);
}

// Half-angle (rad) of the cone about the mirror direction that holds 85 % of the GGX lobe's energy: the
// half-vector of D(h)(n.h) has cdf 1 - cos^2/(...) -> tan^2(theta_h) = alpha^2 * u / (1 - u); reflection doubles it.
float specular_half_angle(float roughness) {
    float alpha = roughness * roughness;
    return min(2.0 * atan(alpha * sqrt(0.85 / 0.15)), 0.45 * PI);
}
