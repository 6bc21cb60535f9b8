// How much of the light from everywhere the objects leave to their own surfaces, as the picture shows them: horizons in slices
// about the direction to the camera (Jimenez et al. 2016, GTAO).
#include "common/seen_pixel.glsl"
#include "common/basis.glsl"
#include "common/interleaved.glsl"

#include "common/pixel_group.glsl"
layout(r16f) writeonly uniform image2D occlusion_out;   // cosine-weighted fraction of the hemisphere that is open
uniform ivec4 rectangle;          // that may show an object: first pixel, size
uniform float occlusion_radius;   // m, within which things count in full, and fade up to twice of it

const float FLAT = 0.01;   // sine of the elevation up to which things are the surface itself, whose normal is of half floats
const int SLICES = 2, STEPS = 16;  // of each of the pixels that INTERLEAVED counts, which are averaged

vec4 object_at(vec2 pixel) {
    ivec2 raster = raster_texel(ivec2(floor(clamp(pixel, vec2(0.0), picture_size - 1.0))));
    bool inside = all(greaterThanEqual(raster, ivec2(0))) && all(lessThan(raster, textureSize(virtual_raster_position, 0)));
    return inside ? texelFetch(virtual_raster_position, raster, 0) : vec4(0.0);
}

vec3 in_camera(vec3 p) { return (camera_from_world * vec4(p, 1.0)).xyz; }

// How far it is along `tangent` to where things count no more or the rectangle ends, m.
float reach(vec3 p, vec3 tangent) {
    float farthest = 2.0 * occlusion_radius;
    vec3 a = in_camera(p), b = in_camera(p + farthest * tangent);
    if (b.z <= 0.0) return farthest;
    vec2 from = picture_pixel(a), path = picture_pixel(b) - from;
    vec2 border = mix(vec2(rectangle.xy), vec2(rectangle.xy + rectangle.zw), greaterThan(path, vec2(0.0)));
    vec2 leave = (border - from) / mix(path, vec2(1e-6), lessThan(abs(path), vec2(1e-6)));
    float part = clamp(min(abs(leave.x), abs(leave.y)), 0.0, 1.0);
    return farthest * part * a.z / (b.z - part * (b.z - a.z));   // uniform in the picture is not uniform in the world
}

// Greatest cosine to v of what stands along `tangent` from p, above its surface; `lowest` is that of p's own horizon.
float horizon(vec3 p, vec3 n, vec3 v, vec3 tangent, float lowest, float shift) {
    float found = lowest, farthest = reach(p, tangent);
    for (int k = 0; k < (occlusion_radius > 0.0 ? STEPS : 0); ++k) {
        float s = (float(k) + shift) / float(STEPS);
        vec3 c = in_camera(p + farthest * s * s * tangent);
        vec4 q = c.z > 0.0 ? object_at(seen_pixel(c)) : vec4(0.0);
        vec3 d = q.xyz - p;
        float away = length(d);
        if (q.w == 0.0 || dot(d, n) <= FLAT * away) continue;
        float counted = clamp(2.0 - away / occlusion_radius, 0.0, 1.0);
        found = max(found, mix(lowest, dot(d, v) / away, counted));
    }
    return found;
}

// Integral of the cosine to a normal at `tilt` between v and a horizon (eq. 7).
float arc(float angle, float tilt) {
    return 0.25 * (-cos(2.0 * angle - tilt) + cos(tilt) + 2.0 * angle * sin(tilt));
}

float open_fraction(vec3 p, vec3 n, vec3 v, vec2 noise) {
    n = normalize(n + max(1e-2 - dot(n, v), 0.0) * v);   // interpolated normals turn away at outlines
    mat3 basis = basis_around(v);
    float seen = 0.0, all = 0.0;
    for (int i = 0; i < SLICES; ++i) {
        float turn = PI * (float(i) + noise.x) / float(SLICES);
        vec3 tangent = basis * vec3(cos(turn), sin(turn), 0.0), across = cross(v, tangent);
        vec3 within = n - across * dot(n, across);
        float size = length(within);
        float tilt = atan(dot(within, tangent), dot(within, v));
        float right = horizon(p, n, v, tangent, cos(min(tilt + 0.5 * PI, PI)), noise.y);
        float left = horizon(p, n, v, -tangent, cos(min(0.5 * PI - tilt, PI)), noise.y);
        float upper = min(acos(clamp(right, -1.0, 1.0)), tilt + 0.5 * PI);
        float lower = max(-acos(clamp(left, -1.0, 1.0)), tilt - 0.5 * PI);
        seen += size * (arc(upper, tilt) + arc(lower, tilt));
        all += size * (arc(tilt + 0.5 * PI, tilt) + arc(tilt - 0.5 * PI, tilt));
    }
    return clamp(seen / max(all, 1e-6), 0.0, 1.0);
}

void main() {
    ivec2 inside = ivec2(gl_GlobalInvocationID.xy), pixel = rectangle.xy + inside;
    if (any(greaterThanEqual(inside, rectangle.zw))) return;
    vec4 p = object_at(vec2(pixel));
    vec3 n = normalize(texelFetch(virtual_raster_normal, raster_texel(pixel), 0).xyz);
    float open = p.w > 0.0 ? open_fraction(p.xyz, n, normalize(camera_position - p.xyz), interleaved(pixel)) : 1.0;
    imageStore(occlusion_out, pixel, vec4(open));
}
