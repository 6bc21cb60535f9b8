// Irradiance from one object's reflected light, added to that of the others, at 1/scale of the picture. REAL: real
// surfaces; otherwise virtual ones, and what a mirror there shows of the objects.
#include "common/harmonics.glsl"
#include "common/object_field.glsl"
#include "common/low_res_grid.glsl"

#include "common/pixel_group.glsl"
layout(rgba32f) uniform image2D bounce_irradiance;   // rgb irradiance
layout(rgba32f) uniform image2D bounce_mirrored;     // rgb radiance
uniform sampler3D bounce_light;                      // a slab per coefficient
#include "common/camera.glsl"
uniform bool first;             // the images are still empty

const int LENGTH = 9;
const float BANDS[3] = float[](3.14159265, 2.09439510, 0.78539816);

void shade(ivec2 texel, SurfacePoint s) {
    vec3 n = turn_to_object(s.normal), q = to_object(s.position);
#ifndef REAL
    q += length(2.0 * shell_halves[0] / float(resolution - 1)) * n;
    float mirror[HARMONICS];
    harmonics(turn_to_object(reflect(normalize(s.position - camera_position), s.normal)), mirror);
#endif
    ShellPlace place = shell_place(q);
    float basis[HARMONICS];
    harmonics(n, basis);
    vec3 e = vec3(0.0), seen = vec3(0.0);
    for (int k = 0; k < (place.fine < 0 ? 0 : LENGTH); ++k) {
        vec3 sent = field_sample(bounce_light, place, LENGTH, k).rgb;
        e += BANDS[int(sqrt(float(k) + 0.5))] * basis[k] * sent;
#ifndef REAL
        seen += mirror[k] * sent;
#endif
    }
    e = max(e, vec3(0.0)) * above_horizon(q, n);
    vec4 before = first ? vec4(0.0) : imageLoad(bounce_irradiance, texel);
    imageStore(bounce_irradiance, texel, before + vec4(e, 0.0));
#ifndef REAL
    vec4 shown = first ? vec4(0.0) : imageLoad(bounce_mirrored, texel);
    imageStore(bounce_mirrored, texel, shown + vec4(max(seen, vec3(0.0)), 0.0));
#endif
}

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, low_resolution_size))) return;
    SurfacePoint s = surface_point(texel);
    if (s.present) shade(texel, s);
}
