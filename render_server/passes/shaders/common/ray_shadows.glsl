// Penumbrae of the objects by rays to points all over a lamp, where some are transparent: beams bring exactly what passes, so shadows
// must be as exact. A map of depths shows only the lit side of things, and at the foot of a ball leaves a fifth of a wide lamp.
// Needs light_shapes.glsl, basis.glsl.
#define MEETS_BACKS   // what is not seen from behind casts shadows all the same
#include "common/ray_mesh.glsl"

const int RAYS = 64;   // a step of them is 1/64 of the lamp's light

// Fraction of a lamp, other than a rectangle, that no object hides from p.
float unblocked_fraction(Light light, vec3 p) {
    vec3 l; float radius;
    unmirrored_light_at(light, p, vec3(0.0), l, radius);
    float end = light.place.w == DIRECTIONAL ? ENDLESS : distance(light.place.xyz, p), open = 0.0;
    mat3 basis = basis_around(l);
    int j = 0;
    do {   // a loop that tests at its end: lights.glsl
        float along = (float(j) + 0.5) / float(RAYS), phi = float(j) * GOLDEN_ANGLE;
        vec2 offset = tan(radius) * sqrt(along) * vec2(cos(phi), sin(phi));
        if (!is_blocked(Ray(p, normalize(basis * vec3(offset, 1.0))), end)) open += 1.0;
    } while (++j < RAYS);
    return open / float(RAYS);
}
