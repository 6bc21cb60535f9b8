// Paths of a ray through transparent objects, which their surfaces divide (docs/method.md 4.11). Before it: MOST_PENDING, the number
// of paths that wait to be traced; LEAST_WEIGHT, of a path that goes on.
#include "common/refraction.glsl"

struct Path { vec3 from; vec3 direction; vec3 weight; int medium; };

Path pending[MOST_PENDING];
int pending_count;

float greatest(vec3 c) { return max(max(c.r, c.g), c.b); }

void push_path(vec3 from, vec3 direction, vec3 weight, int medium) {
    if (pending_count < MOST_PENDING && greatest(weight) > LEAST_WEIGHT) pending[pending_count++] = Path(from, direction, weight, medium);
}

// Splits a path at a surface into a transmitted and a reflected one; with `passes_only`, into the transmitted one alone.
void split_path(Interface i, Path path, bool passes_only) {
    bool inside = path.medium >= 0;
    vec3 reflectance = interface_reflectance(i, path.direction, inside);
    int beyond = inside || materials[i.material].medium.w == 0.0 ? -1 : i.material;
    vec3 back = mirrored(i, path.direction), through = refracted(i, path.direction, inside);
    if (!passes_only) push_path(leave(i, back), back, path.weight * reflectance, path.medium);
    push_path(leave(i, through), through, path.weight * (1.0 - reflectance) * i.surface.passing, beyond);
}
