// Albedo of the real surface at each texel of a light's map with points in the volume, from the picture where the
// camera sees it: albedo = pi B_lin / E_mu ([P2] eq. 1, with visibility and ambient light).
#include "common/light_rays.glsl"
#include "common/environment.glsl"
#include "common/volume.glsl"
#include "common/real_radiance.glsl"
#include "common/map_texels.glsl"
#include "common/albedo_range.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image2D albedo_out;
uniform sampler2D real_rsm_normal;
#pragma texels rgba16f real_rsm_normal
uniform int view_index;
uniform int filled_volume;
uniform float bias_real;   // m

// Irradiance of a light that nothing blocks.
vec3 unblocked(Light light, vec3 p, vec3 n) {
    vec3 to_light; float radius;
    vec3 e_perp = light_at(light, p, n, to_light, radius);
    return e_perp * max(dot(n, to_light), 0.0);
}

// Real direct and ambient light. The map's own light reaches its texels by definition, so its shadows are not looked for.
vec3 irradiance(vec3 p, vec3 n) {
    vec3 e = environment_irradiance(n);
    int own = light_of_view(view_index);
    vec3 of_own = is_object_lamp(listed_light(own)) ? vec3(0.0) : unblocked(listed_light(own), p, n);   // the picture lacks these
    int j = 0;
    if (light_count > 1) do {
        if (j == own) e += of_own;   // sums in the lights' order
        Light light = listed_light(j < own ? j : j + 1);
        e += unblocked(light, p, n) * real_visibility(light, p, n, bias_real);
    } while (++j < light_count - 1);
    return own == light_count - 1 ? e + of_own : e;
}

const float SNAP_REACH = 0.5;   // voxels: split_inject searches a touched voxel this near (SNAP along each axis)

// Whether light that hits a surface within `around` (m) of p may go into a voxel of the volume.
bool reaches_volume(vec3 p, float around) {
    vec3 q = volume_coordinate(p);
    return distance(q, clamp(q, vec3(0.0), vec3(float(volume_size)))) <= around / voxel_edge + SNAP_REACH;
}

bool is_wanted(LightView view, ivec2 texel) {
    float depth = first_depth(real_rsm_depth, view, texel);
    vec2 s = texel_lateral(view, texel);
    return depth != NOTHING && reaches_volume(ray_point(view, s, depth), hit_spread(view, s, depth));
}

vec3 albedo_at(LightView view, ivec2 texel) {
    vec3 p = ray_point(view, texel_lateral(view, texel), first_depth(real_rsm_depth, view, texel));
    if (!camera_sees(p)) return unseen_albedo(p);
    vec3 n = normalize(texelFetch(real_rsm_normal, texel, 0).xyz);
    vec3 to_light; float radius;
    light_at(listed_light(light_of_view(view_index)), p, to_light, radius);
    if (dot(n, to_light) < 0.0) n = -n;   // what the light sees faces it
    return clamp(PI * measured_radiance(p) / max(irradiance(p, n), vec3(1e-6)), ALBEDO_RANGE.x, ALBEDO_RANGE.y);
}

void main() {
    work_in_volume(filled_volume);
    LightView view = listed_view(view_index);
    uint i = next_wanted(view, first_item());
    if (i < texels_of(view)) do {
        ivec2 texel = map_texel(view, i);
        imageStore(albedo_out, texel, vec4(albedo_at(view, texel), 1.0));
        i = next_wanted(view, i + items_apart());
    } while (i < texels_of(view));
}
