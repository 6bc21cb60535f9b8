// After each light of split injection: its flux over the area of the surface that it lights is what it adds to the
// voxel's radiance. Lights see the same surface, so their areas do not add up.
#define TOUCHED_ACCESS readonly
#include "common/voxel_store.glsl"
#include "common/walk.glsl"
#include "common/split_sums.glsl"

layout(local_size_x = 64) in;
layout(std430) buffer Light { int light[]; };

void main() {
    for (uint i = first_item(); i < slot_count; i += items_apart()) {
        uint at = i * uint(LIGHT_SUMS);
        int area = light[at + AREA];
        if (area == 0) continue;   // the light does not reach it
        for (int j = 0; j < AREA; ++j) {
            light[at + ALL_DELTA + j] += fixed_point(float(light[at + j]) / float(area));
            light[at + j] = 0;
        }
        light[at + ALL_AREA] = max(light[at + ALL_AREA], area);
        light[at + AREA] = 0;
    }
}
