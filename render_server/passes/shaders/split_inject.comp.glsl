// Split-inject ([P1] 3.2): the reflected flux of every texel of a light's map goes into its voxel, and the area of the
// surface that its rays light; split_radiance divides one by the other (docs/method.md 4.3). VIRTUAL walks the objects'
// map: +Phi_rho where the light meets the object (V_delta and V_rho). REAL walks the real map: -Phi_mu of what the
// objects keep the light off (V_delta), +Phi of what they leave lit (V_rho).
#include "common/volume.glsl"
#define GRID_ACCESS readonly
#include "common/voxel_store.glsl"
#include "common/light_rays.glsl"
#include "common/interleaved_gradient_noise.glsl"
#ifdef VIRTUAL
#include "common/materials.glsl"
#ifdef EXTENDED
#include "common/coating.glsl"
#endif
#endif
#include "common/packing.glsl"
#include "common/split_sums.glsl"
#include "common/map_texels.glsl"

layout(local_size_x = 64) in;
layout(std430) buffer Sums { int sums[]; };   // per slot of the set that is walked (split_sums.glsl)
uniform sampler2D real_albedo;
uniform sampler2D real_rsm_normal;
uniform sampler2D object_rsm_uv;
uniform sampler2D object_rsm_normal;
#pragma texels rgba16f real_albedo real_rsm_normal object_rsm_normal
#pragma texels rgba32f object_rsm_uv
uniform int view_index;
uniform int filled_volume;
uniform float bias_real;   // m: how far behind the real map an object's surface may be and still be lit

const float SNAP = 0.25;   // voxels: a surface on the border of two voxels belongs to the one that it touched
// Voxels: what lies just above a border (ABOVE_BORDERS of passes/volumes.py) stays there in spite of a map's rounding:
// rasterisers snap corners of triangles to 1/256 of a texel.
const float ABOVE_ROUNDING = 0.01;

uint entry_at(vec3 q) {
    return inside_volume(q) ? grid[voxel_index(ivec3(q) + ivec3(0, 0, volume * volume_size), volume_size)] : 0u;
}

// Slot of the touched voxel at q, a hair above, or next to it, -1 if there is none.
int slot_near(vec3 q) {
    uint entry = entry_at(q + ABOVE_ROUNDING);
    int j = 0;
    if (entry == 0u) do {
        vec3 corner = vec3(j & 1, (j >> 1) & 1, j >> 2) * 2.0 - 1.0;
        entry = entry_at(q + ABOVE_ROUNDING + SNAP * corner);
    } while (entry == 0u && ++j < 8);
    return int(entry) - 1;
}

// Where thousands of texels share a face of a voxel, each brings a few steps of fixed point, and all the same error of
// rounding: there they round up or down in turn, and their sum is right. Elsewhere the error is below 0.002.
const float MANY = 4096.0;   // texels
float even = -1.0;           // 0..1: what is added before rounding down, another for each texel; negative: round to the nearest

void choose_rounding(LightView view, ivec2 texel, float depth) {
    float across = voxel_edge / texel_side(view, depth);
    even = across * across > MANY ? interleaved_gradient_noise(vec2(texel)) : -1.0;
}

int rounded(float amount) { return even < 0.0 ? fixed_point(amount) : int(floor(amount * FIXED_POINT + even)); }

// Sums of the texels of one voxel that a thread comes to one after another: one addition to memory for all of them.
int open_slot = -1;
ivec3 open_delta = ivec3(0), open_rho = ivec3(0);
int open_area = 0;

// Adds the open sums to memory.
void flush_sums() {
    if (open_slot < 0) return;
    int at = open_slot * LIGHT_SUMS;
    for (int j = 0; j < 3; ++j) {
#ifndef VIRTUAL   // what objects gain in V_delta is what they gain in V_rho (split_radiance)
        atomicAdd(sums[at + DELTA + j], open_delta[j]);
#endif
        atomicAdd(sums[at + RHO + j], open_rho[j]);
    }
    atomicAdd(sums[at + AREA], open_area);
}

// Makes a slot the open one.
void select_slot(int slot) {
    if (slot == open_slot) return;
    flush_sums();
    open_slot = slot;
    open_delta = open_rho = ivec3(0);
    open_area = 0;
}

// Flux and area per voxel face, so that fixed point serves every scale.
ivec3 parts_of(vec3 flux) {
    vec3 parts = flux / (PI * voxel_edge * voxel_edge);
    return ivec3(rounded(parts.r), rounded(parts.g), rounded(parts.b));
}

void accumulate(int slot, bool shadowed, vec3 flux, float area) {
    select_slot(slot);
    ivec3 parts = parts_of(flux);
    if (shadowed) open_delta -= parts; else open_rho += parts;
    open_area += rounded(area / (voxel_edge * voxel_edge));
}

// Of a light that comes with an object.
void accumulate_gain(int slot, vec3 flux, float area) {
    select_slot(slot);
    ivec3 parts = parts_of(flux);
    open_delta += parts;
    open_rho += parts;
    open_area += rounded(area / (voxel_edge * voxel_edge));
}

#ifdef VIRTUAL
vec3 virtual_albedo(ivec2 texel) {
    vec4 uv = texelFetch(object_rsm_uv, texel, 0);
    Material m = material_of(int(texelFetch(object_rsm_normal, texel, 0).w), uv.xy, unpack_color(uv.z), 0.0);
    vec3 albedo = mean_diffuse_reflectance(m.diffuse, m.f0, m.roughness) + mean_specular_reflectance(m.f0, m.roughness);
#ifdef EXTENDED
    albedo = mean_coated_reflectance(m, albedo);
#endif
    return albedo;
}

bool is_wanted(LightView view, ivec2 texel) { return first_depth(object_rsm_depth, view, texel) != NOTHING; }

void split(Light light, LightView view, ivec2 texel) {
    vec2 s = texel_lateral(view, texel);
    float depth = first_depth(object_rsm_depth, view, texel);
    vec3 p = ray_point(view, s, depth);
    choose_rounding(view, texel, depth);
    Hit real = first_hit(real_rsm_depth, light.views.x, light.views.y, p);
    if (real.present && real.depth < real.ray_depth - bias_real) return;
    int slot = slot_near(volume_coordinate(p));
    if (slot < 0) return;
    vec3 flux = texel_light(light, view, s) * within_range(light, p) * virtual_albedo(texel);
    vec3 n = normalize(texelFetch(object_rsm_normal, texel, 0).xyz);
    accumulate(slot, false, flux, lit_area(light, view, s, p, n));
}
#else
bool is_wanted(LightView view, ivec2 texel) {
    float depth = first_depth(real_rsm_depth, view, texel);
    return depth != NOTHING && inside_volume(volume_coordinate(ray_point(view, texel_lateral(view, texel), depth)));
}

void split(Light light, LightView view, ivec2 texel) {
    vec2 s = texel_lateral(view, texel);
    float depth = first_depth(real_rsm_depth, view, texel);
    vec3 p = ray_point(view, s, depth);
    choose_rounding(view, texel, depth);
    int slot = slot_near(volume_coordinate(p));
    if (slot < 0) return;
    Hit object = first_hit(object_rsm_depth, light.views.z, light.views.w, p);
    bool shadowed = object.present && object.depth <= object.ray_depth + bias_real;
    vec3 flux = texel_light(light, view, s) * within_range(light, p) * texelFetch(real_albedo, texel, 0).rgb;
    vec3 n = normalize(texelFetch(real_rsm_normal, texel, 0).xyz);
    float area = lit_area(light, view, s, p, n);
    if (is_object_lamp(light)) {
        if (shadowed) flux = vec3(0.0);
        accumulate_gain(slot, flux, area);
    } else {
        accumulate(slot, shadowed, flux, area);
    }
}
#endif

void main() {
    work_in_volume(filled_volume);
    LightView view = listed_view(view_index);
    Light light = listed_light(light_of_view(view_index));
    uint i = next_wanted(view, first_item());
    if (i < texels_of(view)) do {
        split(light, view, map_texel(view, i));
        i = next_wanted(view, i + items_apart());
    } while (i < texels_of(view));
    flush_sums();
}
