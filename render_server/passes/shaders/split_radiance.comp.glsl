// After each light of split injection: its flux over the area of the surface that it lights is what it adds to the
// voxel's radiance. Lights see the same surface, so their areas do not add up.
#define TOUCHED_ACCESS readonly
#include "common/voxel_store.glsl"
#include "common/walk.glsl"
#include "common/split_sums.glsl"

layout(local_size_x = 64) in;
layout(std430) buffer Sums { int sums[]; };
uniform bool of_objects;   // they gain in V_delta what they gain in V_rho, which is summed once

void main() {
    for (uint i = first_item(); i < slot_count; i += items_apart()) {
        uint at = i * uint(LIGHT_SUMS);
        int area = sums[at + AREA];
        if (area == 0) continue;   // the light does not reach it
        for (int j = 0; j < AREA; ++j) {
            int flux = sums[at + (of_objects && j < RHO ? RHO + j : j)];
            sums[at + ALL_DELTA + j] += fixed_point(float(flux) / float(area));
            sums[at + j] = 0;
        }
        sums[at + ALL_AREA] = max(sums[at + ALL_AREA], area);
        sums[at + AREA] = 0;
    }
}
