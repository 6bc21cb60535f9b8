// Sampling of a GGX lobe.
#include "common/basis.glsl"

const float LEAST_ALPHA = 1e-4;   // sharper lobes are narrower than any pixel

// Half-vector about z of the lobe's visible normals, seen from v (Dupuy and Benyoub 2023).
vec3 visible_normal(vec2 u, vec3 v, float alpha) {
    vec3 stretched = normalize(vec3(alpha * v.xy, v.z));
    float z = (1.0 - u.y) * (1.0 + stretched.z) - stretched.z;
    float phi = 2.0 * PI * u.x;
    vec3 h = vec3(sqrt(clamp(1.0 - z * z, 0.0, 1.0)) * vec2(cos(phi), sin(phi)), z) + stretched;
    return normalize(vec3(alpha * h.xy, h.z));
}
