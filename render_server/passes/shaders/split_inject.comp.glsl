// Split-inject ([P1] 3.2): the reflected flux of every texel of a light's map goes into its voxel, and the area of the
// surface that its rays light; split_radiance divides one by the other (docs/method.md 4.3). VIRTUAL walks the objects'
// map: +Phi_rho where the light meets the object (V_delta and V_rho). REAL walks the real map: -Phi_mu of what the
// objects keep the light off (V_delta), +Phi of what they leave lit (V_rho).
#define GRID_ACCESS readonly
#include "common/voxel_store.glsl"
#include "common/light_rays.glsl"
#include "common/even_noise.glsl"
#ifdef VIRTUAL
#include "common/materials.glsl"
#endif
#include "common/packing.glsl"
#include "common/volume.glsl"
#include "common/split_sums.glsl"
#include "common/map_texels.glsl"

layout(local_size_x = 64) in;
layout(std430) buffer RealLight { int real_light[]; };         // per slot, below
layout(std430) readonly buffer VirtualGrid { uint virtual_grid[]; };
layout(std430) buffer VirtualLight { int virtual_light[]; };
uniform sampler2D real_albedo;
uniform sampler2D real_light_normal;
uniform sampler2D virtual_light_uv;
uniform sampler2D virtual_light_normal;
#pragma texels rgba16f real_albedo real_light_normal virtual_light_normal
#pragma texels rgba32f virtual_light_uv
uniform int view_index;
uniform float bias_real;   // m: how far behind the real map an object's surface may be and still be lit

const bool REAL_SET = true, VIRTUAL_SET = false;
const float SNAP = 0.25;   // voxels: a surface on the border of two voxels belongs to the one that it touched
// Voxels: what lies just above a border (ABOVE_BORDERS of passes/volumes.py) stays there in spite of a map's rounding:
// rasterisers snap corners of triangles to 1/256 of a texel.
const float ABOVE_ROUNDING = 0.01;

uint grid_at(bool real_set, ivec3 voxel) {
    uint i = voxel_index(voxel, volume_size);
    return real_set ? grid[i] : virtual_grid[i];
}

// Slot of the touched voxel at q, a hair above, or next to it, -1 if there is none.
int slot_near(bool real_set, vec3 q) {
    for (int j = -1; j < 8; ++j) {
        vec3 corner = j < 0 ? vec3(0.0) : vec3(j & 1, (j >> 1) & 1, j >> 2) * 2.0 - 1.0;
        vec3 at = q + ABOVE_ROUNDING + SNAP * corner;
        if (!inside_volume(at)) continue;
        uint entry = grid_at(real_set, ivec3(at));
        if (entry != 0u) return int(entry) - 1;
    }
    return -1;
}

// Where thousands of texels share a face of a voxel, each brings a few steps of fixed point, and all the same error of
// rounding: there they round up or down in turn, and their sum is right. Elsewhere the error is below 0.002.
const float MANY = 4096.0;   // texels
float even = -1.0;           // 0..1: what is added before rounding down, another for each texel; negative: round to the nearest

void choose_rounding(LightView view, ivec2 texel, float depth) {
    float across = voxel_edge / texel_side(view, depth);
    even = across * across > MANY ? even_noise(vec2(texel)) : -1.0;
}

void add(bool real_set, int at, float amount) {
    int part = even < 0.0 ? fixed_point(amount) : int(floor(amount * FIXED_POINT + even));
    if (real_set) atomicAdd(real_light[at], part); else atomicAdd(virtual_light[at], part);
}

// Flux and area per voxel face, so that fixed point serves every scale.
void add_flux(bool real_set, int slot, int volume, vec3 flux) {
    for (int j = 0; j < 3; ++j)
        add(real_set, slot * LIGHT_SUMS + volume + j, flux[j] / (PI * voxel_edge * voxel_edge));
}

void add_area(bool real_set, int slot, float area) {
    add(real_set, slot * LIGHT_SUMS + AREA, area / (voxel_edge * voxel_edge));
}

#ifdef VIRTUAL
vec3 virtual_albedo(ivec2 texel) {
    vec4 uv = texelFetch(virtual_light_uv, texel, 0);
    Material m = material_of(int(texelFetch(virtual_light_normal, texel, 0).w), uv.xy, unpack_color(uv.z), 0.0);
    return mean_diffuse_reflectance(m.diffuse, m.f0, m.roughness) + mean_specular_reflectance(m.f0, m.roughness);
}

bool is_wanted(LightView view, ivec2 texel) { return first_depth(virtual_light_depth, view, texel) != NOTHING; }

void split(Light light, LightView view, ivec2 texel) {
    vec2 s = texel_lateral(view, texel);
    float depth = first_depth(virtual_light_depth, view, texel);
    vec3 p = ray_point(view, s, depth);
    choose_rounding(view, texel, depth);
    Hit real = first_hit(real_light_depth, light.views.x, light.views.y, p);
    if (real.present && real.depth < real.ray_depth - bias_real) return;
    int slot = slot_near(VIRTUAL_SET, volume_coordinate(p));
    if (slot < 0) return;
    vec3 flux = texel_light(light, view, s) * virtual_albedo(texel);
    add_flux(VIRTUAL_SET, slot, DELTA, flux);
    add_flux(VIRTUAL_SET, slot, RHO, flux);
    vec3 n = normalize(texelFetch(virtual_light_normal, texel, 0).xyz);
    add_area(VIRTUAL_SET, slot, lit_area(light, view, s, p, n));
}
#else
bool is_wanted(LightView view, ivec2 texel) {
    float depth = first_depth(real_light_depth, view, texel);
    return depth != NOTHING && inside_volume(volume_coordinate(ray_point(view, texel_lateral(view, texel), depth)));
}

void split(Light light, LightView view, ivec2 texel) {
    vec2 s = texel_lateral(view, texel);
    float depth = first_depth(real_light_depth, view, texel);
    vec3 p = ray_point(view, s, depth);
    choose_rounding(view, texel, depth);
    int slot = slot_near(REAL_SET, volume_coordinate(p));
    if (slot < 0) return;
    Hit object = first_hit(virtual_light_depth, light.views.z, light.views.w, p);
    bool shadowed = object.present && object.depth <= object.ray_depth + bias_real;
    vec3 flux = texel_light(light, view, s) * texelFetch(real_albedo, texel, 0).rgb;
    add_flux(REAL_SET, slot, shadowed ? DELTA : RHO, shadowed ? -flux : flux);
    vec3 n = normalize(texelFetch(real_light_normal, texel, 0).xyz);
    add_area(REAL_SET, slot, lit_area(light, view, s, p, n));
}
#endif

void main() {
    LightView view = listed_view(view_index);
    Light light = listed_light(light_of_view(view_index));
    uint i = next_wanted(view, first_item());
    if (i < texels_of(view)) do {
        split(light, view, map_texel(view, i));
        i = next_wanted(view, i + items_apart());
    } while (i < texels_of(view));
}
