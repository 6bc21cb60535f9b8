// Injects `sent_out(surfel, normal)` (radiosity) from each side of every surfel of a store into the volume. Needs
// voxel_store.glsl, inject_light.glsl and that function. BOTH: the surfels of the objects follow those of the real scene, and send
// `sent_out_by_object(surfel, normal)`.
#include "common/walk.glsl"
#ifdef BOTH
layout(std430) readonly buffer VirtualSurfels { uint virtual_surfel_count; Surfel virtual_surfels[]; };

uint all_surfels() { return surfels_held() + min(virtual_surfel_count, uint(virtual_surfels.length())); }
bool is_of_object(uint i) { return i >= surfels_held(); }
Surfel surfel_of(uint i) { return is_of_object(i) ? virtual_surfels[i - surfels_held()] : surfels[i]; }
vec3 sent(uint i, Surfel s, vec3 n) { return is_of_object(i) ? sent_out_by_object(s, n) : sent_out(s, n); }
#else
uint all_surfels() { return surfels_held(); }
bool is_of_object(uint i) { return true; }   // where there are maps
Surfel surfel_of(uint i) { return surfels[i]; }
vec3 sent(uint i, Surfel s, vec3 n) { return sent_out(s, n); }
#endif

void inject_side(uint i, Surfel s, vec3 n) {
    vec3 radiosity = sent(i, s, n);
    float area = s.position_area.w;
#ifdef MATERIAL_MAPS
    if (is_of_object(i)) area *= opacity_of(int(s.normal_material.w), s.uv_voxel.xy, s.tint.w, sqrt(area));
#endif
    if (radiosity != vec3(0.0)) inject(s.position_area.xyz, n, radiosity * area);
}

void main() {
    uint count = all_surfels();
    for (uint i = first_item(); i < count; i += items_apart()) {
        Surfel s = surfel_of(i);
        int sides = s.uv_voxel.w > 0.5 ? 2 : 1;   // a loop: software renderers would run a branch for all
        for (int side = 0; side < sides; ++side)
            inject_side(i, s, side == 0 ? s.normal_material.xyz : -s.normal_material.xyz);
    }
}
