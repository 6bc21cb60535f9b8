// A ray marched across the camera's picture until it hits a visible real surface ([D] 4.4.2). What is behind something
// in the picture is unknown: the ray is lost there. It strides over STRIDE pixels, and goes pixel by pixel only through
// the stride at whose end it is behind the picture's surface.
#include "common/geometry.glsl"
#include "common/seen_pixel.glsl"

uniform float noise_sigma;    // m at 1 m

const float NEAREST = 0.02;     // m in front of the camera
const float FARTHEST = 20.0;    // m along the ray
const int MOST_STEPS = 4096;    // pixels: longer than any picture's diagonal
const int STRIDE = 8;           // pixels
const float FADE_PIXELS = 4.0;  // at the picture's border, so that no seam shows
// Sine of the least angle of incidence for a reliable hit: a pixel of the surface then spans ten pixels across.
const float FLATTEST = 0.1;

// `point` on a real surface whose middle `pixel` shows; `fraction`: its reliability, 0 where the ray was lost.
struct ScreenHit { float distance; vec2 pixel; float depth; float fraction; };

bool in_picture(vec2 pixel) { return all(greaterThanEqual(pixel, vec2(0.0))) && all(lessThan(pixel, picture_size)); }

// Fraction of the segment from p to p + path (pixels) that is inside the picture; p is.
float fraction_in_picture(vec2 p, vec2 path) {
    vec2 safe = mix(path, vec2(1e-6), lessThan(abs(path), vec2(1e-6)));
    vec2 border = mix(vec2(0.0), picture_size, greaterThan(safe, vec2(0.0)));
    vec2 leave = (border - p) / safe;
    return clamp(min(leave.x, leave.y), 0.0, 1.0);
}

// From `from` (world) along d until a hit; `spread`: diameter of the cone at distance 1.
ScreenHit screen_hit(vec3 from, vec3 d, float spread) {
    ScreenHit hit = ScreenHit(FARTHEST, vec2(0.0), 1.0, 0.0);
    vec3 a = (camera_from_world * vec4(from, 1.0)).xyz, v = mat3(camera_from_world) * d;
    if (a.z <= NEAREST) return hit;
    float reach = v.z < 0.0 ? min(FARTHEST, (NEAREST - a.z) / v.z) : FARTHEST;
    float near_a = 1.0 / a.z, near_b = 1.0 / (a.z + reach * v.z);
    vec2 first = picture_pixel(a), path = picture_pixel(a + reach * v) - first;
    if (!in_picture(first)) return hit;
    float last = fraction_in_picture(first, path);
    int steps = min(int(ceil(max(abs(path.x), abs(path.y)) * last)), MOST_STEPS);
    float before = 0.0, t, depth;
    int i = 0, next, fine_until = 0;
    vec2 pixel;
    vec4 seen;
    bool inside;
    if (steps > 0) do {
        // Most steps are in front of all surfaces: the lanes of a processor take them in a loop of their own.
        bool searches;
        do {
            next = i < fine_until ? i + 1 : min(i + STRIDE, steps);
            float s = last * float(next) / float(steps);
            t = reach * s * near_b / mix(near_a, near_b, s);   // uniform in the picture is not uniform in the world
            vec3 c = a + t * v;
            pixel = seen_pixel(c);
            depth = c.z;
            inside = in_picture(pixel);
            seen = inside ? texelFetch(real_surface_position, ivec2(pixel), 0) : vec4(0.0);
            bool stops = !inside || (seen.w > 0.0 && depth > seen.w), strides = next > i + 1;
            searches = !stops || strides;
            if (!stops) { before = t; i = next; }
            else if (strides) fine_until = next;
        } while (searches && i < steps);
        if (i == steps || !inside) break;
        vec3 n = texelFetch(real_surface_normal, ivec2(pixel), 0).xyz;
        float tolerance = 3.0 * noise_sigma * seen.w * seen.w, towards = -dot(n, d);
        float at = dot(n, from - seen.xyz) / max(towards, 1e-6);
        if (towards > 0.0 && at > before - (t - before) - tolerance / max(towards, FLATTEST)) {
            hit = ScreenHit(max(at, 0.0), pixel, depth, smoothstep(0.0, FLATTEST, towards));
            break;
        }
        if (depth > seen.w + tolerance) break;
        before = t;
        i = next;
    } while (i < steps);
    if (hit.fraction > 0.0) {   // refines the hit on the surface: at most a pixel off
        vec3 c = a + hit.distance * v;
        if (c.z > NEAREST) { hit.pixel = seen_pixel(c); hit.depth = c.z; }
        vec2 rim = min(hit.pixel, picture_size - hit.pixel);
        float wide = 0.5 * spread * hit.distance * camera_pinhole.x / hit.depth;
        hit.fraction *= clamp(min(rim.x, rim.y) / max(wide, FADE_PIXELS), 0.0, 1.0);
    }
    return hit;
}

// The picture over the cone's width there.
vec3 screen_radiance(ScreenHit hit, float spread) {
    float wide = spread * hit.distance * camera_pinhole.x / hit.depth;
    return textureLod(linear_picture, hit.pixel / picture_size, log2(max(wide, 1.0))).rgb;
}
