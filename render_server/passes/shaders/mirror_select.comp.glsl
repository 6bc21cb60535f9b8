// Lists the pixels of smooth surfaces whose lobe can reach the virtual objects; the others reflect none.
#include "common/mirror.glsl"
#define APPENDS_TEXELS
#include "common/work_list.glsl"

#include "common/pixel_group.glsl"
layout(rgba16f) writeonly uniform image2D reflection;
layout(rgba16f) writeonly uniform image2D traced;
layout(r16f) writeonly uniform image2D hit_distance;
uniform sampler2D object_coverage;
#pragma texels r16f object_coverage
#ifdef OF_OBJECTS
uniform sampler2D hit_position;
#pragma texels rgba32f hit_position
uniform int scale;

// Whether rays of the texels around met any object. A mirror stands among the objects, so their bounds say nothing.
bool reaches_objects(ivec2 pixel, Mirror m) {
    ivec2 texel = pixel / scale, last = textureSize(hit_position, 0) - 1;
    for (int k = 0; k < 9; ++k)
        if (texelFetch(hit_position, clamp(texel + ivec2(k % 3, k / 3) - 1, ivec2(0), last), 0).w > 0.0) return true;
    return false;
}
#else
uniform vec3 bounds_centre;
uniform float bounds_radius;

const float LOBE_FRACTION = 0.99;   // of its energy: extent of the traced lobe

bool reaches_objects(ivec2 pixel, Mirror m) {
    vec3 mirrored = reflect(normalize(m.point - camera_position), m.normal);
    vec3 to = bounds_centre - m.point;
    float distance = length(to);
    if (distance <= bounds_radius) return true;
    float lobe = 2.0 * atan(m.alpha * sqrt(LOBE_FRACTION / (1.0 - LOBE_FRACTION)));   // as in specular_half_angle
    return acos(clamp(dot(to, mirrored) / distance, -1.0, 1.0)) < asin(bounds_radius / distance) + lobe;
}
#endif

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    ivec2 size = textureSize(object_coverage, 0);
    if (any(greaterThanEqual(pixel, size))) return;
    Mirror m = mirror_at(pixel);
    if (m.present && shows_mirror(texelFetch(object_coverage, pixel, 0).r) && reaches_objects(pixel, m)) {
        append_texel(pixel, size.x);
        return;
    }
    imageStore(reflection, pixel, vec4(0.0));
    imageStore(traced, pixel, vec4(0.0));
    imageStore(hit_distance, pixel, vec4(0.0));
}
