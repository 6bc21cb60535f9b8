// The real surfaces around an object as a light source: each texel of the reduced picture is a patch with the
// measured radiance, summed over the directions in which the object's middle sees it. CHANGED: with its light as
// changed by the objects.
#include "common/geometry.glsl"
#include "common/light_probe.glsl"
#include "common/object_field.glsl"

#include "common/pixel_group.glsl"
uniform isampler2D sample_pixels;
uniform sampler2D linear_picture;
#pragma texels rgba16i sample_pixels
layout(std430) buffer ProbeSums { int sums[]; };   // 4 per texel: radiance x solid angle, solid angle
#ifdef CHANGED
uniform sampler2D changes;   // light_change.comp.glsl
#pragma texels rgba16f changes
#endif
#include "common/camera.glsl"
uniform int scale;

const float STEPS = 1048576.0;   // per sr and unit of radiance: 2000 units over a texel's 12 msr fit
const float GRAZING = 0.1;       // least cosine of a patch: one seen at a more grazing angle counts no larger

void add(ivec2 at, vec4 value) {
    if (any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, ivec2(PROBE_SIZE)))) return;
    int first = 4 * (at.y * PROBE_SIZE + at.x);
    for (int i = 0; i < 4; ++i) atomicAdd(sums[first + i], int(round(STEPS * value[i])));
}

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, textureSize(sample_pixels, 0)))) return;
    ivec2 pixel = texelFetch(sample_pixels, texel, 0).xy;
    if (pixel.x < -1) pixel = -2 - pixel;   // behind an object: the picture itself shows it
    if (pixel.x < 0) return;
    vec4 position = texelFetch(real_surface_position, pixel, 0);
    vec3 normal = texelFetch(real_surface_normal, pixel, 0).xyz;
    vec3 to_camera = camera_position - position.xyz, direction = position.xyz - field_middle();
    float slant = length(to_camera), away2 = dot(direction, direction);
    float facing = -dot(normal, direction) * inversesqrt(max(away2, 1e-12));
    if (facing <= 0.0) return;
    float cosine = max(dot(normal, to_camera) / slant, GRAZING);
    float area = float(scale * scale) * position.w * position.w * position.w
        / (camera_pinhole.x * camera_pinhole.y * slant * cosine);
    float solid_angle = area * facing / (away2 + area / 3.14159265);
    vec2 size = vec2(textureSize(linear_picture, 0));
    vec3 radiance = textureLod(linear_picture, (vec2(pixel) + 0.5) / size, log2(float(scale))).rgb;
#ifdef CHANGED
    radiance *= texelFetch(changes, texel, 0).rgb;
#endif
    vec2 at = octahedral_uv(turn_to_object(direction)) * float(PROBE_SIZE) - 0.5;
    ivec2 low = ivec2(floor(at));
    vec2 f = at - vec2(low);
    for (int j = 0; j < 4; ++j) {
        ivec2 o = ivec2(j & 1, j >> 1);
        float fraction = (o.x == 1 ? f.x : 1.0 - f.x) * (o.y == 1 ? f.y : 1.0 - f.y);
        add(low + o, fraction * solid_angle * vec4(radiance, 1.0));
    }
}
