// The real surface where the lights' maps show it. A world kept for a moving camera shows that of an earlier frame, and poses by a board differ from
// frame to frame by more than depth is noisy: what lies beneath the surface of the maps would be in its shadow. Needs geometry.glsl.
#pragma switch KEEPS_WORLD
#ifdef KEEPS_WORLD
#include "common/earlier_picture.glsl"

uniform sampler2D kept_position;   // of the frame that the world was built from, as real_surface_position
uniform sampler2D kept_normal;
uniform mat4 kept_camera_from_world;

const float FARTHEST_OFF = 0.1;    // of the depth: what was seen farther off its plane is another surface,
const float LEAST_ALIKE = 0.7071;  // and so is what faces another way (cosine)

// A point, moved along its normal to the surface that the earlier frame saw there; beside that picture, to the one at its edge.
vec3 on_kept_surface(vec3 p, vec3 normal) {
    ivec2 last = textureSize(kept_position, 0) - 1;
    ivec2 pixel = clamp(ivec2(earlier_pixel(kept_camera_from_world, p)), ivec2(0), last);
    vec4 kept = texelFetch(kept_position, pixel, 0);
    float off = dot(kept.xyz - p, normal);
    bool same = kept.w > 0.0 && abs(off) < FARTHEST_OFF * kept.w
        && dot(texelFetch(kept_normal, pixel, 0).xyz, normal) > LEAST_ALIKE;
    return same ? p + off * normal : p;
}
#else
vec3 on_kept_surface(vec3 p, vec3 normal) { return p; }
#endif
