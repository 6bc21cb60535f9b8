// The real surface where the lights' maps show it. A world kept for a moving camera shows that of an earlier frame, and poses by a board differ from
// frame to frame by more than depth is noisy: what lies beneath the surface of the maps would be in its shadow. Needs geometry.glsl,
// basis.glsl.
#pragma switch KEEPS_WORLD
#ifdef KEEPS_WORLD
#include "common/earlier_picture.glsl"

uniform sampler2D kept_position;   // of the frame that the world was built from, as real_surface_position
uniform sampler2D kept_normal;
uniform mat4 kept_camera_from_world;

const float FARTHEST_OFF = 0.1;    // of the depth: what was seen farther off the point's plane is another surface,
const float LEAST_ALIKE = 0.7071;  // and so is what faces another way (cosine)
const int TRIES = 12;              // in holes of depth, and beside that picture,
const float FARTHER = 0.0125;      // each by so much of the picture's width farther away

// A point, lifted along its normal to the plane through what the earlier frame saw there, or nearby of the same surface, if it lies
// deeper beneath that than `noise` (m).
vec3 on_kept_surface(vec3 p, vec3 normal, float noise) {
    vec2 last = vec2(textureSize(kept_position, 0) - 1);
    vec2 there = clamp(earlier_pixel(kept_camera_from_world, p), vec2(0.0), last);
    float off = 0.0;
    bool same = false;
    int j = 0;
    do {
        float away = float(j) * FARTHER * last.x, angle = float(j) * GOLDEN_ANGLE;
        ivec2 pixel = ivec2(clamp(there + away * vec2(cos(angle), sin(angle)), vec2(0.0), last));
        vec4 kept = texelFetch(kept_position, pixel, 0);
        off = dot(kept.xyz - p, normal);
        same = kept.w > 0.0 && abs(off) < FARTHEST_OFF * kept.w
            && dot(texelFetch(kept_normal, pixel, 0).xyz, normal) > LEAST_ALIKE;
    } while (!same && ++j < TRIES);
    return same && off > noise ? p + off * normal : p;
}
#else
vec3 on_kept_surface(vec3 p, vec3 normal, float noise) { return p; }
#endif
