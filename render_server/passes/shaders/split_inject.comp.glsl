// Split-inject ([P1] 3.2): the reflected flux of every texel of a light's map goes into its voxel, as radiance
// Phi / (pi h^2). VIRTUAL walks the objects' map: +Phi_rho where the light meets the object (V_delta and V_rho), and
// -Phi_mu where the same rays met the real scene before (V_delta). REAL walks the real map: +Phi of what the objects
// leave lit (V_rho).
#define GRID_ACCESS readonly
#include "common/voxel_store.glsl"
#include "common/light_rays.glsl"
#ifdef VIRTUAL
#include "common/materials.glsl"
#endif
#include "common/packing.glsl"
#include "common/volume.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
layout(std430) buffer RealLight { int real_light[]; };         // 6 per slot: V_delta, V_rho
layout(std430) readonly buffer VirtualGrid { uint virtual_grid[]; };
layout(std430) buffer VirtualLight { int virtual_light[]; };
uniform sampler2D real_albedo;
uniform sampler2D real_light_normal;
uniform sampler2D virtual_light_uv;
uniform sampler2D virtual_light_normal;
uniform int view_index;
uniform float bias_real;   // m: how far behind the real map an object's surface may be and still be lit

const bool REAL_SET = true, VIRTUAL_SET = false;
const int DELTA = 0, RHO = 3, LIGHT_SUMS = 6;
const float SNAP = 0.25;   // voxels: a surface on the border of two voxels belongs to the one that it touched

uint grid_at(bool real_set, ivec3 voxel) {
    uint i = voxel_index(voxel, volume_size);
    return real_set ? grid[i] : virtual_grid[i];
}

// Slot of the touched voxel at q or next to it, -1 if there is none.
int slot_near(bool real_set, vec3 q) {
    for (int j = -1; j < 8; ++j) {
        vec3 corner = j < 0 ? vec3(0.0) : vec3(j & 1, (j >> 1) & 1, j >> 2) * 2.0 - 1.0;
        vec3 at = q + SNAP * corner;
        if (!inside_volume(at)) continue;
        uint entry = grid_at(real_set, ivec3(at));
        if (entry != 0u) return int(entry) - 1;
    }
    return -1;
}

void add(bool real_set, int at, vec3 radiance) {
    for (int j = 0; j < 3; ++j) {
        int part = fixed_point(radiance[j]);
        if (real_set) atomicAdd(real_light[at + j], part); else atomicAdd(virtual_light[at + j], part);
    }
}

vec3 voxel_radiance(vec3 flux) { return flux / (PI * voxel_edge * voxel_edge); }

void inject_real(vec3 p, vec3 flux, int volume) {
    int slot = slot_near(REAL_SET, volume_coordinate(p));
    if (slot >= 0) add(REAL_SET, slot * LIGHT_SUMS + volume, voxel_radiance(flux));
}

void inject_virtual(vec3 p, vec3 flux) {
    int slot = slot_near(VIRTUAL_SET, volume_coordinate(p));
    if (slot < 0) return;
    add(VIRTUAL_SET, slot * LIGHT_SUMS + DELTA, voxel_radiance(flux));
    add(VIRTUAL_SET, slot * LIGHT_SUMS + RHO, voxel_radiance(flux));
}

#ifdef VIRTUAL
vec3 virtual_albedo(ivec2 texel) {
    vec4 uv = texelFetch(virtual_light_uv, texel, 0);
    Material m = material_of(int(texelFetch(virtual_light_normal, texel, 0).w), uv.xy, unpack_color(uv.z));
    return m.diffuse + m.f0;
}

void split(Light light, LightView view, ivec2 texel) {
    float depth = first_depth(virtual_light_depth, view, texel);
    if (depth == NOTHING) return;
    vec2 s = texel_lateral(view, texel);
    vec3 p = ray_point(view, s, depth);
    vec3 arriving = texel_light(light, view, s);
    Hit real = first_hit(real_light_depth, light.views.x, light.views.y, p);
    if (real.present && real.depth < real.ray_depth - bias_real) return;
    inject_virtual(p, arriving * virtual_albedo(texel));
    if (!real.present) return;
    vec3 shadowed = hit_point(real, texelFetch(real_light_normal, real.texel, 0).xyz);
    inject_real(shadowed, -arriving * texelFetch(real_albedo, real.texel, 0).rgb, DELTA);
}
#else
void split(Light light, LightView view, ivec2 texel) {
    float depth = first_depth(real_light_depth, view, texel);
    if (depth == NOTHING) return;
    vec2 s = texel_lateral(view, texel);
    vec3 p = ray_point(view, s, depth);
    if (!inside_volume(volume_coordinate(p))) return;
    Hit object = first_hit(virtual_light_depth, light.views.z, light.views.w, p);
    if (object.present && object.depth <= object.ray_depth + bias_real) return;
    inject_real(p, texel_light(light, view, s) * texelFetch(real_albedo, texel, 0).rgb, RHO);
}
#endif

void main() {
    LightView view = light_views[view_index];
    if (any(greaterThanEqual(vec2(gl_GlobalInvocationID.xy), view.tile.zz))) return;
    split(lights[light_of_view(view_index)], view, ivec2(gl_GlobalInvocationID.xy) + ivec2(view.tile.xy));
}
