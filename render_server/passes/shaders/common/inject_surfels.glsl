// Injects `sent_out(surfel, normal)` (radiosity) from each side of every surfel of a store into the volume. Needs
// voxel_store.glsl, inject_light.glsl and that function.
#include "common/walk.glsl"

void inject_side(Surfel s, vec3 n) {
    vec3 radiosity = sent_out(s, n);
    float area = s.position_area.w;
#ifdef MATERIAL_MAPS
    area *= opacity_of(int(s.normal_material.w), s.uv_voxel.xy, s.tint.w, sqrt(area));
#endif
    if (radiosity != vec3(0.0)) inject(s.position_area.xyz, n, radiosity * area);
}

void main() {
    uint count = surfels_held();
    for (uint i = first_item(); i < count; i += items_apart()) {
        Surfel s = surfels[i];
        int sides = s.uv_voxel.w > 0.5 ? 2 : 1;   // a loop: software renderers would run a branch for all
        for (int side = 0; side < sides; ++side)
            inject_side(s, side == 0 ? s.normal_material.xyz : -s.normal_material.xyz);
    }
}
