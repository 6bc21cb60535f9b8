// Texels of a light's map that a pass works on, of all that its threads walk (common/walk.glsl): a thread goes on to its
// next one before it works, because software renderers compute for all lanes of a vector what one of them needs.
#include "common/lights.glsl"
#include "common/quotient.glsl"
#include "common/walk.glsl"

bool is_wanted(LightView view, ivec2 texel);   // cheap beside the pass's work

uint texels_of(LightView view) { return uint(view.tile.z) * uint(view.tile.z); }

ivec2 map_texel(LightView view, uint i) {
    int side = int(view.tile.z), row = quotient(int(i), side);
    return ivec2(view.tile.xy) + ivec2(int(i) - row * side, row);
}

// The first of a thread's items from i on that is wanted; texels_of(view) or more: none.
uint next_wanted(LightView view, uint i) {
    bool found = false;
    if (i < texels_of(view)) do {
        found = is_wanted(view, map_texel(view, i));
        if (!found) i += items_apart();
    } while (!found && i < texels_of(view));
    return i;
}
