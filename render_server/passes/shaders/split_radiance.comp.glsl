// After each light of split injection: its flux over the area of the surface that it lights is what it adds to the
// voxel's radiance. Lights see the same surface, so their areas do not add up. Walks the real set, then the virtual one.
#define TOUCHED_ACCESS readonly
#include "common/voxel_store.glsl"
#include "common/walk.glsl"
#include "common/split_sums.glsl"

layout(local_size_x = 64) in;
layout(std430) buffer Sums { int sums[]; };
layout(std430) readonly buffer VirtualTouched { uint virtual_count; uint virtual_touched[]; };
layout(std430) buffer VirtualSums { int virtual_sums[]; };

int radiance(int flux, int area) { return fixed_point(float(flux) / float(area)); }

void divide_real(uint at) {
    int area = sums[at + AREA];
    if (area == 0) return;   // the light does not reach it
    for (int j = 0; j < AREA; ++j) {
        sums[at + ALL_DELTA + j] += radiance(sums[at + j], area);
        sums[at + j] = 0;
    }
    sums[at + ALL_AREA] = max(sums[at + ALL_AREA], area);
    sums[at + AREA] = 0;
}

// Objects gain in V_delta what they gain in V_rho, which is summed once.
void divide_virtual(uint at) {
    int area = virtual_sums[at + AREA];
    if (area == 0) return;
    for (int j = RHO; j < AREA; ++j) {
        int gained = radiance(virtual_sums[at + j], area);
        virtual_sums[at + ALL_DELTA + j - RHO] += gained;
        virtual_sums[at + ALL_DELTA + j] += gained;
        virtual_sums[at + j] = 0;
    }
    virtual_sums[at + ALL_AREA] = max(virtual_sums[at + ALL_AREA], area);
    virtual_sums[at + AREA] = 0;
}

void main() {
    for (uint i = first_item(); i < slot_count; i += items_apart()) divide_real(i * uint(LIGHT_SUMS));
    for (uint i = first_item(); i < virtual_count; i += items_apart()) divide_virtual(i * uint(LIGHT_SUMS));
}
