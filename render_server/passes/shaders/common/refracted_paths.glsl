// Paths of a ray through transparent objects, which their surfaces divide (docs/method.md 4.11). Before it: MOST_PENDING, the number
// of paths that wait to be traced; LEAST_WEIGHT, of a path that goes on.
#include "common/refraction.glsl"

#ifdef FOOTPRINTS
#include "common/ray_differentials.glsl"
#endif

struct Path {
    vec3 from; vec3 direction; vec3 weight; int medium;
#ifdef FOOTPRINTS
    Footprint footprint;
#endif
};

Path pending[MOST_PENDING];
int pending_count;

float greatest(vec3 c) { return max(max(c.r, c.g), c.b); }

void push_path(Path path) {
    if (pending_count < MOST_PENDING && greatest(path.weight) > LEAST_WEIGHT) pending[pending_count++] = path;
}

// Splits a path at a surface into a transmitted and a reflected one; with `passes_only`, into the transmitted one alone.
void split_path(Interface i, Path path, bool passes_only) {
    bool inside = path.medium >= 0;
    vec3 reflectance = interface_reflectance(i, path.direction, inside);
    Path back = path, through = path;
    back.direction = mirrored(i, path.direction);
    through.direction = refracted(i, path.direction, inside);
    back.from = leave(i, back.direction);
    through.from = leave(i, through.direction);
    back.weight *= reflectance;
    through.weight *= (1.0 - reflectance) * i.surface.passing;
    through.medium = inside || materials[i.material].medium.w == 0.0 ? -1 : i.material;
#ifdef FOOTPRINTS
    back.footprint.turn = mirrored_turn(i, path.direction, path.footprint);
    through.footprint.turn = refracted_turn(i, path.direction, through.direction, relative_index(i, inside), path.footprint);
#endif
    if (!passes_only) push_path(back);
    push_path(through);
}
