// Residual environment R(direction, cone): radiance in camera units, prefiltered by cones of growing half-angle.
#include "passes/common/octahedral.glsl"

layout(binding = 12) uniform sampler2D environment_map;   // octahedral; level l averaged over a cone
uniform int environment_levels;
uniform float environment_first_half_angle;               // rad, of level 1; doubles each level

vec3 environment(vec3 direction, float half_angle) {
    float level = half_angle <= 0.0 ? 0.0 : 1.0 + log2(half_angle / environment_first_half_angle);
    level = clamp(level, 0.0, float(environment_levels - 1));
    return textureLod(environment_map, octahedral_uv(direction), level).rgb;
}

layout(binding = 13) uniform sampler2D irradiance_map;    // octahedral; E(n) of R, no occlusion

vec3 environment_irradiance(vec3 normal) { return textureLod(irradiance_map, octahedral_uv(normal), 0.0).rgb; }
