// Ends beams at the first surface that they hit, of the real scene as the camera sees it or of the objects. Needs geometry.glsl,
// beams.glsl, camera.glsl.
#include "common/basis.glsl"
#include "common/sent_beams.glsl"
uniform float reach;                // m: how far beams are traced

const float OVERLAP = 0.6;          // deviation / distance to the next beam: their sum is even within a few percent
const float MARCH_PIXELS = 2.0;     // a step of the march over the depth image
const int MARCH_STEPS = 512;

// Distance at which a ray hits the visible real scene, 1e30 if it does not.
float meets_real(vec3 from, vec3 direction, float limit) {
    float t = 0.0;
    for (int i = 0; i < MARCH_STEPS && t < limit; ++i) {
        vec3 p = from + t * direction;
        vec3 c = (camera_from_world * vec4(p, 1.0)).xyz;
        vec2 pixel = camera_pinhole.xy * c.xy / c.z + camera_pinhole.zw + 0.5;
        if (c.z <= 0.0 || any(lessThan(pixel, vec2(0.0))) || any(greaterThanEqual(pixel, picture_size))) break;
        float stride = MARCH_PIXELS * c.z / camera_pinhole.x;
        vec4 seen = texelFetch(real_surface_position, ivec2(pixel), 0);
        vec3 n = texelFetch(real_surface_normal, ivec2(pixel), 0).xyz;
        float before = dot(p - seen.xyz, n), slope = dot(direction, n);
        if (seen.w > 0.0 && before <= 0.0 && slope < 0.0 && distance(p, seen.xyz) < 4.0 * stride)
            return max(t - before / slope, 0.0);
        t += stride;
    }
    return 1e30;
}

// The footprint's variance has a fraction of the distance to the next beams along both axes, and `round`, each beam's
// own standard deviation in all directions.
void set_footprint(inout Beam beam, RayDifferential x, RayDifferential y, float round) {
    mat3 basis = basis_around(beam.direction.xyz);
    vec2 a = OVERLAP * ((x.start + beam.from.w * x.turn) * basis).xy;
    vec2 b = OVERLAP * ((y.start + beam.from.w * y.turn) * basis).xy;
    float xx = a.x * a.x + b.x * b.x + round * round, xy = a.x * a.y + b.x * b.y;
    float yy = a.y * a.y + b.y * b.y + round * round;
    float det = max(xx * yy - xy * xy, 1e-20);
    beam.inverse_variance = vec4(vec3(yy, -xy, xx) / det, 1.0 / (2.0 * PI * sqrt(det) * FOOTPRINT_FRACTION));
    float half_sum = 0.5 * (xx + yy);
    beam.direction.w = FOOTPRINT_CUT * sqrt(half_sum + sqrt(max(half_sum * half_sum - det, 0.0)));
}

// Where a beam ends, if within reach.
bool ends(SentBeam sent, out Beam beam) {
    float object = sent.from.w, real = meets_real(sent.from.xyz, sent.direction.xyz, min(object, reach));
    beam.from = vec4(sent.from.xyz, min(object, real));
    if (beam.from.w > reach) return false;
    beam.direction = vec4(sent.direction.xyz, 0.0);
    beam.flux = vec4(sent.flux.rgb, real < object ? 0.0 : 1.0);
    RayDifferential x = RayDifferential(sent.start_x.xyz, sent.turn_x.xyz), y = RayDifferential(sent.start_y.xyz, sent.turn_y.xyz);
    set_footprint(beam, x, y, sent.direction.w * beam.from.w);
    return true;
}

uint beams_sent() { return min(sent_count, uint(sent_beams.length())); }
