// For each point of a smooth plane: the fraction of a light that it mirrors, without and with the objects. None where
// the plane is covered, or visibly ends; where something hides it, it is assumed to continue.
#include "common/lights.glsl"
#include "common/geometry.glsl"
#include "common/surfaces.glsl"

#include "common/pixel_group.glsl"
layout(rg16f) writeonly uniform image2DArray visibility_out;
uniform int first_image;       // index of the first light that is a mirror image
#include "common/camera.glsl"
uniform float bias_real;       // m
uniform float noise_m;         // of depth, m

float height_of(Light light, vec3 p) { return dot(light.plane.xyz, p) + light.plane.w; }

bool is_mirroring(Light light, vec3 q, int surface) {
    if (surface_entry(q, -2.0) != surface) return false;
    vec3 c = (camera_from_world * vec4(q, 1.0)).xyz;
    ivec2 size = textureSize(real_surface_position, 0);
    ivec2 pixel = ivec2(floor(camera_pinhole.xy * c.xy / c.z + camera_pinhole.zw + 0.5));
    if (c.z <= 0.0 || any(lessThan(pixel, ivec2(0))) || any(greaterThanEqual(pixel, size))) return true;
    vec4 seen = texelFetch(real_surface_position, pixel, 0);
    float height = height_of(light, seen.xyz);
    float tolerance = light.color.w + noise_m;
    if (seen.w <= 0.0 || height > tolerance) return true;
    return height >= -tolerance && int(texelFetch(real_surface_normal, pixel, 0).w) == surface;
}

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy), size = imageSize(visibility_out).xy;
    int layer = int(gl_GlobalInvocationID.z);
    if (any(greaterThanEqual(texel, size))) return;
    Light light = listed_light(first_image + layer);
    vec2 uv = (vec2(texel) + 0.5) / vec2(size) - vec2(light.map_u.w, light.map_v.w);
    vec3 u = light.map_u.xyz, v = light.map_v.xyz;
    vec3 q = u * (uv.x / dot(u, u)) + v * (uv.y / dot(v, v)) - light.plane.xyz * light.plane.w;
    vec2 shown = vec2(0.0);
    if (is_mirroring(light, q, int(light.axis_u.w)))
        shown = visibility(listed_light(int(light.axis_v.w)), q, light.plane.xyz, bias_real, 0.0);
    imageStore(visibility_out, ivec3(texel, layer), vec4(shown, 0.0, 0.0));
}
