// Residual environment R(direction, cone): radiance in camera units, averaged over cones of doubling half-angle.
#include "common/octahedral.glsl"
#include "common/basis.glsl"

uniform sampler2DArray environment_map;   // octahedral; a layer per cone size
#include "common/lighting.glsl"

vec3 environment(vec3 direction, float half_angle) {
    float layer = log2(max(half_angle, 1e-6) / environment_first_half_angle);
    layer = clamp(layer, 0.0, float(environment_layers - 1));
    vec2 uv = octahedral_uv(direction);
    float low = floor(layer);
    vec3 a = textureLod(environment_map, vec3(uv, low), 0.0).rgb;
    vec3 b = textureLod(environment_map, vec3(uv, min(low + 1.0, float(environment_layers - 1))), 0.0).rgb;
    return mix(a, b, layer - low);
}

// E(n) of R without any occlusion.
vec3 environment_irradiance(vec3 normal) {
    return PI * textureLod(environment_map, vec3(octahedral_uv(normal), float(environment_layers - 1)), 0.0).rgb;
}
