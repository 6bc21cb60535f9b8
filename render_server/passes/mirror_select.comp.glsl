// List the pixels of smooth real surfaces whose lobe can reach the virtual objects; the others reflect none.
#include "passes/common/mirror.glsl"
#include "passes/common/texel_list.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
layout(binding = 0, rgba16f) writeonly uniform image2D reflection;
layout(binding = 1, rgba16f) writeonly uniform image2D traced;
layout(binding = 2, r16f) writeonly uniform image2D way;
layout(binding = 1) uniform sampler2D matte;
uniform vec3 bounds_centre;
uniform float bounds_radius;

const float LOBE_SHARE = 0.99;   // of its energy: how far out the lobe is followed

bool reaches_objects(Mirror m) {
    vec3 mirrored = reflect(normalize(m.point - camera_position), m.normal);
    vec3 to = bounds_centre - m.point;
    float distance = length(to);
    if (distance <= bounds_radius) return true;
    float lobe = 2.0 * atan(m.alpha * sqrt(LOBE_SHARE / (1.0 - LOBE_SHARE)));   // as specular_half_angle has it
    return acos(clamp(dot(to, mirrored) / distance, -1.0, 1.0)) < asin(bounds_radius / distance) + lobe;
}

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    ivec2 size = textureSize(matte, 0);
    if (any(greaterThanEqual(pixel, size))) return;
    Mirror m = mirror_at(pixel);
    if (m.present && texelFetch(matte, pixel, 0).r < 1.0 && reaches_objects(m)) {
        append_texel(pixel, size.x);
        return;
    }
    imageStore(reflection, pixel, vec4(0.0));
    imageStore(traced, pixel, vec4(0.0));
    imageStore(way, pixel, vec4(0.0));
}
