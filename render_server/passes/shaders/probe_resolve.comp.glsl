// Sums of measured light -> radiance of each direction: the environment fills directions without patches.
#include "common/environment.glsl"
#include "common/light_probe.glsl"
#include "common/object_field.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image2D probe;   // rgb radiance; a: fraction that the camera sees
layout(std430) readonly buffer ProbeSums { int sums[]; };

const float STEPS = 1048576.0;
const float TEXEL_HALF_ANGLE = 0.0625;   // rad, of a cone as wide as a texel

void main() {
    int texel = int(gl_GlobalInvocationID.x);
    if (texel >= PROBE_TEXELS) return;
    vec4 seen = vec4(sums[4 * texel], sums[4 * texel + 1], sums[4 * texel + 2], sums[4 * texel + 3]) / STEPS;
    float fraction = min(seen.a / texel_solid_angle(texel), 1.0);
    vec3 measured = seen.a > 0.0 ? seen.rgb / seen.a : vec3(0.0);
    vec3 beyond = environment(world_from_object * texel_direction(texel), TEXEL_HALF_ANGLE);
    ivec2 at = ivec2(texel % PROBE_SIZE, texel / PROBE_SIZE);
    imageStore(probe, at, vec4(mix(beyond, measured, fraction), fraction));
}
