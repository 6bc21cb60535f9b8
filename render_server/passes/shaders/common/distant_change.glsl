// The lattice's change of light (distant_change.comp.glsl) on the reduced grid, by distance and by how well surfaces continue each
// other; it fades out where the volume's own cones fade in. Needs REAL.
#include "common/volume.glsl"
#include "common/low_res_grid.glsl"
#include "common/continuation.glsl"
#include "common/least_change.glsl"
uniform sampler2D lattice_change;
uniform isampler2D lattice_pixels;

// A tent over 4 x 4 points weights the four parts of their directions equally.
vec3 interpolated(ivec2 texel, SurfacePoint s) {
    vec2 at = (vec2(texel) + 0.5) / float(LATTICE_STEP) - 0.5, f = fract(at);
    ivec2 base = ivec2(floor(at)), last = textureSize(lattice_change, 0) - 1;
    float size = float(LATTICE_STEP) * sample_distance * (camera_from_world * vec4(s.position, 1.0)).z, total = 1e-6;
    vec3 sum = vec3(0.0);
    for (int j = 0; j < 16; ++j) {
        ivec2 o = ivec2(j & 3, j >> 2) - 1, point = clamp(base + o, ivec2(0), last);
        vec2 offset = abs(vec2(o) - f);
        vec4 change = texelFetch(lattice_change, point, 0);
        if (change.a == 0.0) continue;
        ivec2 pixel = texelFetch(lattice_pixels, point, 0).xy;
        vec3 sp = texelFetch(real_surface_position, pixel, 0).xyz, sn = texelFetch(real_surface_normal, pixel, 0).xyz;
        float w = (2.0 - offset.x) * (2.0 - offset.y) + 1e-3;
        w *= continuation(s.position, s.normal, sp, sn, size) + 1e-4;
        sum += w * change.rgb;
        total += w;
    }
    return sum / total;
}

vec3 distant_change(ivec2 texel) {
    SurfacePoint s = surface_point(texel);
    if (!s.present) return vec3(0.0);
    enter_volume(s.position);
    vec3 change = (1.0 - volume_fade(volume_coordinate(s.position))) * interpolated(texel, s);
    return any(greaterThanEqual(abs(change), vec3(LEAST_CHANGE))) ? change : vec3(0.0);
}
