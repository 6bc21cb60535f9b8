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
#include "common/refracted_paths.glsl"
#include "common/shown_pixels.glsl"
#include "common/walk.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) readonly uniform image2D reflected_radiance;   // of the objects
layout(rgba16f) writeonly uniform image2D radiance_out;
uniform float pixel_size;      // m at 1 m depth
shared vec4 first_normals[64]; // of the transparent surface that each ray meets first; w: 1 if there is one
shared vec3 of_ray[64];        // radiance along its paths
#include "common/camera.glsl"

const float NOWHERE = 1e30;        // distance of what a ray does not meet
const int MOST_SURFACES = 24;      // that the paths of one ray may meet
const float NARROWEST = 1e-3;      // rad: half-angle of the smallest lamp

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

// What a path sees that leaves the transparent objects: the picture where it `shows` the hit there, and what lies beyond; `object`:
// distance of the next surface of any object.
vec3 outside(vec3 from, vec3 d, float spread, float object, ScreenHit hit, bool shows) {
    vec4 seen = shows ? shown_at(hit, spread) : vec4(0.0);
    if (seen.a >= 1.0) return seen.rgb;
    float open = 1.0;
#ifdef VOXELS
    vec3 beyond = look_in_voxels(from, d, spread, open);
#else
    vec3 beyond = environment(d, atan(0.5 * spread));
#endif
    if (object >= NOWHERE && open > 0.0) beyond += open * lamps_along(from, d, spread);
    return seen.rgb + (1.0 - seen.a) * beyond;
}

// Radiance along all paths of a ray that meets a transparent surface first.
vec3 trace_paths(Ray ray, MeshHit hit, float spread) {
    vec3 sum = vec3(0.0);
    pending_count = 0;
    Path path = Path(ray.from, ray.direction, vec3(1.0), -1);
    MeshHit object = hit;
    float before = 0.0;   // m, of the way to the ray's start
    int met = 0;
    do {   // one turn for the first surface, too, because drivers compile each call of a long function anew
        bool is_first = met == 0;
        bool stops = object.triangle < 0 || !is_transparent(material_of_triangle(max(object.triangle, 0)));
        bool is_last = stops || met == MOST_SURFACES, shown = false;
        ScreenHit real;
        if (!is_first && (is_last || path.medium < 0)) {
            real = screen_hit(path.from, path.direction, spread);
            shown = real.fraction > 0.0 && real.distance < object.distance;
        }
        if (is_last || shown) {
            float inside_m = object.triangle < 0 ? 0.0 : object.distance;
            sum += path.weight * kept_over(path.medium, inside_m)
                * outside(path.from, path.direction, spread, object.distance, real, shown);
        } else {
            path.weight *= kept_over(path.medium, object.distance);
            // What the first surface reflects is left out: it is the object's own reflection already.
            split_path(interface_at(object, Ray(path.from, path.direction), pixel_size * (before + object.distance)), path, is_first);
        }
        if (pending_count == 0) break;
        before = hit.distance;
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

// Diameter at distance 1 of what a ray stands for: each of two rough surfaces turns it by n - 1 of the turn of its microfacets, and so
// do both curved ones from ray to ray, `turned` apart.
float spread_behind(Interface first, float turned) {
    float bent = max(materials[first.material].medium.w, 1.0) - 1.0;
    float alpha = first.surface.roughness * first.surface.roughness;
    return bent * length(vec2(sqrt(2.0) * MEDIAN_DISC * alpha, 2.0 * turned)) + pixel_size;
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

// Greatest difference of the normals that this ray and the others of its pixel, from invocation `first` on, meet.
float turn_between(uint inside, uint first) {
    float turned = 0.0;
    for (uint k = first; k < first + uint(RAY_COUNT); ++k)
        if (first_normals[k].w > 0.0) turned = max(turned, distance(first_normals[inside].xyz, first_normals[k].xyz));
    return turned;
}

vec3 mean_of_rays(uint first) {
    vec3 sum = vec3(0.0);
    float count = 0.0;
    for (uint k = first; k < first + uint(RAY_COUNT); ++k) {
        if (first_normals[k].w == 0.0) continue;
        sum += of_ray[k];
        count += 1.0;
    }
    return sum / max(count, 1.0);
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
    bool enters = hit.triangle >= 0;
    first_normals[inside] = enters ? vec4(interface_at(hit, ray, 0.0).normal, 1.0) : vec4(0.0);
    memoryBarrierShared();
    barrier();
    if (enters) of_ray[inside] = trace_paths(ray, hit, spread_behind(interface_at(hit, ray, 0.0), turn_between(inside, first)));
    memoryBarrierShared();
    barrier();
    if (j != 0u || !listed) return;
    vec4 own = imageLoad(reflected_radiance, pixel);
    imageStore(radiance_out, pixel, vec4(own.rgb + mean_of_rays(first), own.a));
}
