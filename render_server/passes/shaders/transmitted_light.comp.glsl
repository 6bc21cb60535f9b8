// What transparent objects show of what is behind them (docs/method.md 4.11): rays from the camera through their surfaces, which
// refract and reflect them, and on into the picture, voxels or environment. Added to what the objects' surfaces reflect. One invocation
// per ray, because Mesa's software renderer silently ends all loops of a thread after 65535 iterations.
#include "common/brdf.glsl"
#include "common/lighting.glsl"
#include "common/light_shapes.glsl"
#include "common/environment.glsl"
#include "common/look.glsl"
#include "common/ray_mesh.glsl"
const int MOST_PENDING = 4;        // paths that are still to be traced
const float LEAST_WEIGHT = 0.004;  // of a path that goes on: a step of 8-bit codes
#define FOOTPRINTS
#include "common/refracted_paths.glsl"
#include "common/shown_pixels.glsl"
#include "common/walk.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) readonly uniform image2D reflected_radiance;   // of the objects
layout(rgba16f) writeonly uniform image2D radiance_out;
uniform float pixel_size;      // m at 1 m depth
shared vec4 of_ray[64];        // radiance along its paths; 1 if it meets a transparent surface first
#include "common/camera.glsl"

const float NOWHERE = 1e30;        // distance of what a ray does not meet
const int MOST_SURFACES = 24;      // that the paths of one ray may meet
const float NARROWEST = 1e-3;      // rad: half-angle of the smallest lamp; least diameter of a cone at distance 1, where rays run to a focus

// Fraction of a cone around d that a disc of half-angle `radius` around l fills. Both are even discs, which overlap by a smooth step from
// where one covers the other to where they part, of the same sum. Chords measure: on a sphere, a disc's area is PI times its chord's square.
float covered_by_disc(vec3 d, vec3 l, float radius, float spread) {
    float lamp = 2.0 * sin(0.5 * radius), cone = 0.5 * spread;
    float wide = max(lamp, cone), narrow = min(lamp, cone);
    float most = min(lamp * lamp / (cone * cone), 1.0) / (1.0 + 0.2 * narrow * narrow / (wide * wide));
    return most * (1.0 - smoothstep(wide - narrow, wide + narrow, distance(d, l)));
}

// Mean radiance of the lamps over a cone around d.
vec3 lamps_along(vec3 from, vec3 d, float spread) {
    vec3 sum = vec3(0.0);
    for (int i = 0; i < light_count; ++i) {
        Light light = listed_light(i);
        if (is_image(light)) continue;   // the picture shows the real one
        vec3 l; float radius;
        vec3 e_perp = unmirrored_light_at(light, from, vec3(0.0), l, radius);
        radius = max(radius, NARROWEST);
        float sine = sin(radius);
        sum += e_perp * (covered_by_disc(d, l, radius, spread) / (PI * sine * sine));
    }
    return sum;
}

// Diameter at distance 1 of a cone, `wide` or as wide as rays at a focus, that is blurred too.
float spread_of(float wide, float blurred) { return max(length(vec2(wide, blurred)), NARROWEST); }

// What a path sees that leaves the transparent objects: the picture where it `shows` the hit there, and what lies beyond; `object`: distance
// of the next surface of any object.
vec3 outside(Path path, float blurred, float object, ScreenHit hit, bool shows) {
    vec3 from = path.from, d = path.direction;
    Footprint f = path.footprint;
    float spread = spread_of(width_of(f.turn), blurred);
    // As far as the hit: a footprint has a width where the path starts, too.
    vec4 seen = shows ? shown_at(hit, spread_of(width_at(f, hit.distance) / max(hit.distance, 1e-6), blurred)) : vec4(0.0);
    if (seen.a >= 1.0) return seen.rgb;
    float open = 1.0;
#ifdef VOXELS
    vec3 beyond = look_in_voxels(from, d, spread, open);
#else
    vec3 beyond = environment(d, atan(0.5 * spread));
#endif
    // Lamps are so small and bright that rays through dense curves glitter where a footprint's narrow axis misses them.
    if (object >= NOWHERE && open > 0.0) beyond += open * lamps_along(from, d, spread_of(longer_width_of(f.turn), blurred));
    return seen.rgb + (1.0 - seen.a) * beyond;
}

// Radiance along all paths of a ray that meets a transparent surface first; `blurred`: diameter at distance 1 by which its roughness widens
// them.
vec3 trace_paths(Path path, MeshHit object, float blurred) {
    vec3 sum = vec3(0.0);
    pending_count = 0;
    int met = 0;
    do {   // one turn for the first surface, too, because drivers compile each call of a long function anew
        bool is_first = met == 0;
        bool stops = object.triangle < 0 || !is_transparent(material_of_triangle(max(object.triangle, 0)));
        bool is_last = stops || met == MOST_SURFACES, shown = false;
        ScreenHit real;
        if (!is_first && (is_last || path.medium < 0)) {
            real = screen_hit(path.from, path.direction, spread_of(width_of(path.footprint.turn), blurred));
            shown = real.fraction > 0.0 && real.distance < object.distance;
        }
        if (is_last || shown) {
            float inside_m = object.triangle < 0 ? 0.0 : object.distance;
            sum += path.weight * kept_over(path.medium, inside_m)
                * outside(path, blurred, object.distance, real, shown);
        } else {
            path.weight *= kept_over(path.medium, object.distance);
            float size = width_at(path.footprint, object.distance);
            Interface i = interface_at(object, Ray(path.from, path.direction), size);
            path.footprint = footprint_at(path.footprint, path.direction, i.face, object.distance);
            i.turn = turn_of_normal(i, object, path.footprint.place);
            // What the first surface reflects is left out: it is the object's own reflection already.
            split_path(i, path, is_first);
        }
        if (pending_count == 0) break;
        path = pending[--pending_count];
        object = closest_hit(Ray(path.from, path.direction));
    } while (++met <= MOST_SURFACES);
    return sum;
}

Ray camera_ray(ivec2 pixel, vec2 within) {
    vec2 ray = texelFetch(picture_rays, pixel, 0).xy + within / camera_pinhole.xy;
    return Ray(camera_position, normalize(transpose(mat3(camera_from_world)) * vec3(ray, 1.0)));
}

vec2 place_within(int j) { return fract(float(j) * vec2(0.7548776662, 0.5698402910) + 0.5) - 0.5; }

// Diameter at distance 1 by which roughness widens a ray: each of two surfaces turns it by n - 1 of the turn of its microfacets.
float blur_behind(Interface first) {
    float bent = max(materials[first.material].medium.w, 1.0) - 1.0;
    return bent * sqrt(2.0) * MEDIAN_DISC * first.surface.roughness * first.surface.roughness;
}

// The first surface that a ray meets, if it is transparent.
MeshHit first_hit(Ray ray) {
    MeshHit hit = closest_hit(ray);
    if (hit.triangle >= 0 && !is_transparent(material_of_triangle(hit.triangle))) hit.triangle = -1;
    return hit;
}

bool shows_transparent(ivec2 pixel) {
    return is_transparent(int(texelFetch(virtual_raster_normal, raster_texel(pixel), 0).w));
}

vec3 mean_of_rays(uint first) {
    vec4 sum = vec4(0.0);
    for (uint k = first; k < first + uint(RAY_COUNT); ++k) sum += of_ray[k];
    return sum.rgb / max(sum.a, 1.0);
}

// The differences of rays that divide a pixel among them.
Footprint footprint_of_ray(vec3 d) {
    mat3 world = transpose(mat3(camera_from_world));
    mat2x3 axes = mat2x3(world[0], world[1]);
    return Footprint(mat2x3(0.0), pixel_size * inversesqrt(float(RAY_COUNT)) * (axes - outerProduct(d, d * axes)));
}

void main() {
    uint inside = gl_LocalInvocationIndex, j = inside % uint(RAY_COUNT), first = inside - j;
    uint group = spread(counted_group(), gl_NumWorkGroups.x * gl_NumWorkGroups.y);
    uint i = group * (64u / uint(RAY_COUNT)) + inside / uint(RAY_COUNT);
    bool listed = i < pixels_shown();
    ivec2 pixel = listed ? shown_pixel(i) : ivec2(0);
    Ray ray = camera_ray(pixel, place_within(int(j)));
    MeshHit hit = MeshHit(NOWHERE, -1, vec2(0.0));
    if (listed && shows_transparent(pixel)) hit = first_hit(ray);
    of_ray[inside] = vec4(0.0);
    if (hit.triangle >= 0) {
        Path path = Path(ray.from, ray.direction, vec3(1.0), -1, footprint_of_ray(ray.direction));
        of_ray[inside] = vec4(trace_paths(path, hit, blur_behind(interface_at(hit, ray, 0.0))), 1.0);
    }
    memoryBarrierShared();
    barrier();
    if (j != 0u || !listed) return;
    vec4 own = imageLoad(reflected_radiance, pixel);
    imageStore(radiance_out, pixel, vec4(own.rgb + mean_of_rays(first), own.a));
}
