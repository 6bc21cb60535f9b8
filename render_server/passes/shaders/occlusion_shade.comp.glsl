// Occlusion of natural light by one object, at 1/scale of the picture ([D] 5.2.3): its field at the point, times the
// product of light and cosine for the normal. Objects are processed in turn; what they leave is multiplied: exact for
// one, and never negative where they overlap. REAL: real surfaces; otherwise virtual ones, the object's own too.
#include "common/brdf.glsl"
#include "common/harmonics.glsl"
#include "common/octahedral.glsl"
#include "common/object_field.glsl"
#include "common/low_res_grid.glsl"

#include "common/pixel_group.glsl"
layout(rgba32f) uniform image2D unoccluded; // rgb: remaining fraction of E
layout(rgba32f) uniform image2D natural;    // rgb: E of each object's surroundings times weight; a: weight
layout(rgba32f) uniform image2D mirrored;   // rgb: mean radiance in the mirror direction times weight; a: remaining fraction
uniform sampler3D occlusion;    // 4 coefficients per slab
uniform sampler3D products;     // light_products.comp.glsl
uniform sampler2D probe;
#include "common/camera.glsl"
uniform bool has_field;         // if not, it is still being computed
uniform bool first;             // the images are still empty

const int GROUPS = (SH_LENGTH + 3) / 4;
const int CONE_SAMPLES = 16;

// Objects' surroundings are weighted by the size of the objects as seen from the point.
float nearness(vec3 q) {
    vec3 direction = (q - field_centre) / object_radius;
    return 1.0 / (0.1 + dot(direction, direction));
}

// Coefficients 4g to 4g + 3 at a position.
vec4 hidden(ShellPlace place, int g) { return field_sample(occlusion, place, GROUPS, g); }

vec3 product(vec2 uv, int layer) {
    return textureLod(products, vec3(uv, (float(layer) + 0.5) / float(SH_LENGTH + 1)), 0.0).rgb;
}

// Mean radiance of the surroundings over a cone about d (unit, object's axes).
vec3 cone_radiance(vec3 d, float half_angle) {
    mat3 basis = basis_around(d);
    vec3 sum = vec3(0.0);
    for (int i = 0; i < CONE_SAMPLES; ++i) {
        float z = mix(1.0, cos(half_angle), (float(i) + 0.5) / float(CONE_SAMPLES)), turn = float(i) * GOLDEN_ANGLE;
        vec3 direction = basis * vec3(sqrt(max(1.0 - z * z, 0.0)) * vec2(cos(turn), sin(turn)), z);
        sum += textureLod(probe, octahedral_uv(direction), 0.0).rgb;
    }
    return sum / float(CONE_SAMPLES);
}

void shade(ivec2 texel, SurfacePoint s) {
    vec3 n = turn_to_object(s.normal), q = to_object(s.position);
    float weight = nearness(q);
    vec2 uv = octahedral_uv(n);
    vec3 e = product(uv, SH_LENGTH), lost = vec3(0.0);
    float dark = 0.0;
    vec3 mirror = turn_to_object(reflect(normalize(s.position - camera_position), s.normal));
#ifndef REAL
    vec3 cell = 2.0 * shell_halves[0] / float(resolution - 1);
    q += length(cell) * n;   // at the object's own surface, samples on the same side are read
    float basis[HARMONICS];
    harmonics(mirror, basis);
#endif
    ShellPlace place = shell_place(q);
    if (has_field && place.fine >= 0) {
        for (int g = 0; g < GROUPS; ++g) {
            vec4 o = hidden(place, g);
            for (int c = 0; c < 4 && 4 * g + c < SH_LENGTH; ++c) {
                lost += o[c] * product(uv, 4 * g + c);
#ifndef REAL
                dark += o[c] * basis[4 * g + c];
#endif
            }
        }
        lost *= above_horizon(q, n);
    }
    vec3 left = 1.0 - clamp(lost / max(e, vec3(1e-6)), 0.0, 1.0);
    vec4 fraction = first ? vec4(1.0) : imageLoad(unoccluded, texel);
    vec4 sum = first ? vec4(0.0) : imageLoad(natural, texel);
    imageStore(unoccluded, texel, fraction * vec4(left, 1.0));
    imageStore(natural, texel, sum + weight * vec4(e, 1.0));
#ifndef REAL
    vec4 m = first ? vec4(0.0, 0.0, 0.0, 1.0) : imageLoad(mirrored, texel);
    m.rgb += weight * cone_radiance(mirror, specular_half_angle(max(s.roughness, 0.0)));
    imageStore(mirrored, texel, vec4(m.rgb, m.a * (1.0 - clamp(dark, 0.0, 1.0))));
#endif
}

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, low_resolution_size))) return;
    SurfacePoint s = surface_point(texel);
    if (s.present) shade(texel, s);
}
