// Where an earlier picture of the same lens shows a point. Needs geometry.glsl.
#include "common/lens.glsl"

// Position in the picture (pixel centres at .5), far outside it for what was behind the camera.
vec2 earlier_pixel(mat4 earlier_camera_from_world, vec3 p) {
    vec3 c = (earlier_camera_from_world * vec4(p, 1.0)).xyz;
    if (c.z <= 0.0) return vec2(-1e4);
    vec2 pixel = camera_pinhole.xy * c.xy / c.z + camera_pinhole.zw + 0.5;
    ivec2 last = textureSize(picture_rays, 0) - 1;
    for (int i = 0; i < (lens_bends ? 2 : 0); ++i) {
        ivec2 at = clamp(ivec2(pixel), ivec2(0), last);
        pixel = vec2(at) + 0.5 + camera_pinhole.xy * (c.xy / c.z - texelFetch(picture_rays, at, 0).xy);
    }
    return pixel;
}
