// Relative change of the light at real surfaces beyond the objects' volumes, on a sparse lattice: one surface in
// LATTICE_STEP x LATTICE_STEP texels of the reduced grid. Cones aim at the ball around what changes.
#include "common/lights.glsl"
#include "common/march.glsl"
#include "common/environment.glsl"
#include "common/diffuse_cones.glsl"
#include "common/low_res_grid.glsl"
#include "common/march_into.glsl"
#include "common/least_change.glsl"
#include "common/rolled.glsl"

#include "common/pixel_group.glsl"
layout(rgba16f) writeonly uniform image2D lattice_change;   // rgb (E_rho - E_mu) / E_mu; a: 1 where known
layout(rgba16i) writeonly uniform iimage2D lattice_pixels;  // xy: the pixel of the surface
uniform sampler2D direct_mu;
uniform sampler2D cone_mu;
uniform sampler2D cone_rho;   // a: 1 inside a volume
#pragma texels rgba16f direct_mu cone_mu cone_rho
uniform float noise_sigma;   // m at 1 m
#include "common/camera.glsl"

const float LEAST_IRRADIANCE = 1e-4, GREATEST_CHANGE = 1e4;   // half floats hold it

// As in trace_cones: four adjacent points share four times as many directions, and common/distant_change.glsl takes the mean.
int part_of(ivec2 point) { return (point.x & 1) + 2 * (point.y & 1); }

// The texel with a real surface that lies nearest to the middle of a block; negative if there is none.
ivec2 texel_of(ivec2 point) {
    ivec2 found = ivec2(-1);
    float nearest = 1e9;
    for (int i = 0; i < rolled(LATTICE_STEP * LATTICE_STEP); ++i) {
        ivec2 inside = ivec2(i % LATTICE_STEP, i / LATTICE_STEP), texel = point * LATTICE_STEP + inside;
        if (any(greaterThanEqual(texel, low_resolution_size)) || texelFetch(sample_pixels, texel, 0).x < 0) continue;
        vec2 offset = vec2(inside) - 0.5 * float(LATTICE_STEP - 1);
        if (dot(offset, offset) < nearest) { nearest = dot(offset, offset); found = texel; }
    }
    return found;
}

vec3 direct_irradiance(SurfacePoint s) {
    vec3 sum = vec3(0.0), away = s.position - camera_position;
    float bias = 3.0 * noise_sigma * dot(away, away);
    int i = 0;
    if (light_count > 0) do {
        vec3 l; float radius;
        vec3 e_perp = light_at(listed_light(i), s.position, s.normal, l, radius);
        float cosine = dot(s.normal, l);
        if (cosine <= 0.0) continue;
        sum += e_perp * cosine * real_visibility(listed_light(i), s.position, s.normal, bias);
    } while (++i < light_count);
    return sum;
}

// Share of the hemisphere about n, weighted by cosine, that a ball fills at most.
float greatest_share(vec3 to_ball, float radius, vec3 n) {
    float ball_distance = length(to_ball), sine = min(radius / ball_distance, 1.0);
    float height = dot(to_ball, n) + radius;
    return height > 0.0 ? sine * sine * min(height / ball_distance, 1.0) : 0.0;
}

// Whether a ray meets what a volume before this one holds: near each other, both hold the same objects.
bool counted_before(int number, vec3 p, vec3 d) {
    bool met = false;
    for (int i = 0; i < number; ++i) {
        work_in_volume(i);
        vec4 ball = ball_around_support();
        vec3 to_ball = ball.xyz - volume_coordinate(p);
        float along = dot(to_ball, d);
        met = met || (along > 0.0 && dot(to_ball, to_ball) - along * along < ball.w * ball.w);
    }
    work_in_volume(number);
    return met;
}

// Change by what is in a volume, of the irradiance at p. Cones are stratified over the ball's cap, or over the hemisphere
// where the ball surrounds the point.
vec3 change_by_volume(int number, vec3 p, vec3 n, int part) {
    work_in_volume(number);
    vec3 q = volume_coordinate(p);
    vec4 ball = ball_around_support();
    vec3 to_ball = ball.xyz - q, sum = vec3(0.0);
    if (greatest_share(to_ball, ball.w, n) < LEAST_CHANGE) return sum;
    float sine = ball.w / max(length(to_ball), 1e-6);
    bool surrounds = sine >= 1.0;
    float cap = 1.0 - sqrt(max(1.0 - sine * sine, 0.0)), share = cap / float(AIMED_CONES);   // solid angles / 2 pi
    float ratio = 0.5 * (surrounds ? cone_ratio() : sqrt(8.0 * share));
    mat3 basis = basis_around(surrounds ? n : normalize(to_ball));
    int k = 0;
    do {
        float index = float(4 * k + part), at = (index + 0.5) / float(4 * AIMED_CONES), phi = index * GOLDEN_ANGLE;
        float z = surrounds ? sqrt(1.0 - at) : 1.0 - at * cap;
        vec3 d = basis * vec3(sqrt(max(1.0 - z * z, 0.0)) * vec2(cos(phi), sin(phi)), z);
        float weight = surrounds ? PI / float(AIMED_CONES) : 2.0 * PI * share * dot(d, n);
        if (weight > 0.0 && !counted_before(number, p, d)) sum += weight * change_along(q, d, ratio);
    } while (++k < AIMED_CONES);
    return sum;
}

vec3 relative_change(SurfacePoint s, int part) {
    vec3 change = vec3(0.0);
    for (int i = 0; i < volume_count; ++i) change += change_by_volume(i, s.position, s.normal, part);
    if (change == vec3(0.0)) return change;
    vec3 e_mu, e_rho;
    enter_volume(s.position);
    diffuse(volume_coordinate(s.position), s.normal, ConeSet(4, part, 0.5, 0.0), true, e_mu, e_rho);
    return change / (direct_irradiance(s) + e_mu + LEAST_IRRADIANCE);
}

// Inside a volume, cones know it already.
vec3 known_change(ivec2 texel, vec3 e_mu, vec3 e_rho) {
    vec3 direct = texelFetch(direct_mu, texelFetch(sample_pixels, texel, 0).xy, 0).rgb;
    return (e_rho - e_mu) / (direct + e_mu + LEAST_IRRADIANCE);
}

void main() {
    ivec2 point = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(point, imageSize(lattice_change)))) return;
    ivec2 texel = texel_of(point), pixel = ivec2(-1);
    vec3 change = vec3(0.0);
    if (texel.x >= 0) {
        pixel = texelFetch(sample_pixels, texel, 0).xy;
        vec4 rho = texelFetch(cone_rho, texel, 0);
        if (rho.a == 1.0) change = known_change(texel, texelFetch(cone_mu, texel, 0).rgb, rho.rgb);
        else change = relative_change(surface_point(texel), part_of(point));
    }
    imageStore(lattice_pixels, point, ivec4(pixel, 0, 0));
    imageStore(lattice_change, point, vec4(clamp(change, vec3(-1.0), vec3(GREATEST_CHANGE)), texel.x >= 0 ? 1.0 : 0.0));
}
