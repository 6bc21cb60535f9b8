// Averages the rays of 3 x 3 pixels where the lobe is wider than that in the picture: their pattern is uniform over 3
// x 3, and does not show as grain.
#include "common/mirror.glsl"
#include "common/work_list.glsl"
#include "common/rolled.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image2D reflection;
uniform sampler2D object_coverage;
uniform sampler2D traced;
uniform sampler2D hit_distance;   // m from the surface to the objects, 0 none
#pragma texels r16f object_coverage hit_distance
#pragma texels rgba16f traced

// Radius in the picture of half of the lobe's energy, pixels; `d`: m to the hit.
float lobe_pixels(Mirror m, float d) { return 2.0 * m.alpha * d / (m.depth + d) * camera_pinhole.x; }

void smooth_pixel(ivec2 pixel) {
    Mirror m = mirror_at(pixel);
    float entry = mirror_entry(pixel), farthest = 0.0, count = 0.0;
    vec4 own = texelFetch(traced, pixel, 0), around = vec4(0.0);
    ivec2 last = textureSize(traced, 0) - 1;
    for (int k = 0; k < rolled(9); ++k) {
        ivec2 at = clamp(pixel + ivec2(k % 3, k / 3) - 1, ivec2(0), last);
        if (mirror_entry(at) != entry || !shows_mirror(texelFetch(object_coverage, at, 0).r)) continue;
        around += texelFetch(traced, at, 0);
        farthest = max(farthest, texelFetch(hit_distance, at, 0).r);
        count += 1.0;
    }
    float smoothing = clamp(lobe_pixels(m, farthest) - 1.0, 0.0, 1.0);
    imageStore(reflection, pixel, mix(own, around / count, smoothing));
}

void main() {
    uint i = counted_group() * 64u + gl_LocalInvocationIndex;
    if (i < listed_count()) smooth_pixel(texel_of_index(texels[i], textureSize(traced, 0).x));
}
