// State of a volume before the first step of what objects change: of their injected light, and of the light without
// them (V_mu), which they block. The total starts with V_mu, so it stays where objects change nothing, however few steps
// both have.
#include "common/light_cells.glsl"
#include "common/light_step.glsl"
#include "common/injected_light.glsl"

#pragma switch HALF_STEP

layout(local_size_x = 16) in;
layout(rgba32f) readonly uniform image3D light_mu;
layout(rgba32f) writeonly uniform image3D state;
layout(rgba32f) writeonly uniform image3D total;
uniform usampler3D transmitted_real;   // without objects
#pragma texels rg32ui transmitted_real
uniform bool in_place;   // as lpv_half_step.comp.glsl has its state: what the total is without light from neighbours

vec4 light_of(ivec3 texel) { return imageLoad(light_mu, texel); }
#include "common/light_neighbours.glsl"

// Before any half step; HALF_STEP: after the first one, of the cells of colour 0.
vec4 total_in_place(ivec3 cell, Neighbours all, int channel, vec4 before, vec4 change) {
#ifdef HALF_STEP
    if (((cell.x + cell.y + cell.z) & 1) == 0) return before + change + entering(cell, all, channel);
#endif
    return before;
}

void main() {
    ivec3 cell = ivec3(gl_GlobalInvocationID);
    if (!in_grid(cell, cells)) return;
    Neighbours all = neighbours_of(cell), real = neighbours_past(cell, has_geometry ? texelFetch(transmitted_real, cell, 0).xy : OPEN);
    float share = in_place ? 0.0 : 1.0;
    Neighbours gained = Neighbours(all.low, all.high, share * all.from_low - real.from_low, share * all.from_high - real.from_high);
    for (int channel = 0; channel < 3; ++channel) {
        ivec3 texel = in_channel(cell, channel, cells);
        vec4 before = light_of(texel), change = injected_light(int(cell_index(cell, cells)), channel) + entering(cell, gained, channel);
        imageStore(state, texel, in_place ? before + change : change);
        imageStore(total, texel, in_place ? total_in_place(cell, all, channel, before, change) : before + change);
    }
}
