// Change of light of the real surface at each texel of the reduced grid due to the objects, lamps and natural light
// together: E_rho / E_mu, before the objects' own reflected light.
#include "common/lights.glsl"
#include "common/low_res_grid.glsl"
#include "common/kept_surface.glsl"

#include "common/pixel_group.glsl"
layout(rgba16f) writeonly uniform image2D changes;
uniform sampler2D unoccluded;
uniform sampler2D natural;
uniform float noise_sigma;   // m at 1 m
#include "common/camera.glsl"

const float LEAST_IRRADIANCE = 1e-4;

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, low_resolution_size))) return;
    SurfacePoint s = surface_point(texel);
    vec3 before = vec3(LEAST_IRRADIANCE), after = before;
    if (s.present) {
        vec4 e = texelFetch(natural, texel, 0);
        vec3 ambient = max(e.rgb / e.a, vec3(0.0)), away = s.position - camera_position;
        float bias = 3.0 * noise_sigma * dot(away, away);
        vec3 on_real = on_kept_surface(s.position, s.normal, bias);
        before += ambient;
        after += ambient * texelFetch(unoccluded, texel, 0).rgb;
        for (int i = 0; i < light_count; ++i) {
            vec3 l; float radius;
            vec3 e_perp = light_at(listed_light(i), s.position, s.normal, l, radius);
            float cosine = dot(s.normal, l);
            if (cosine <= 0.0) continue;
            vec2 seen = visibility(listed_light(i), s.position, on_real, s.normal, bias, bias);
            before += e_perp * cosine * seen.x;
            after += e_perp * cosine * seen.y;
        }
    }
    imageStore(changes, texel, vec4(after / before, 1.0));
}
