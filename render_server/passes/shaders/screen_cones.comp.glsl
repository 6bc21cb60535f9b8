// Reflections of the visible real scene in smooth virtual surfaces, by cones across the picture ([D] 4.4.2): the
// picture's radiance there, times the objects' change of its light. What a cone does not find in the picture it looks
// up in voxels (VOXELS), or that fraction of the lobe is left to other passes.
#include "common/brdf.glsl"
#include "common/octahedral.glsl"
#define TWO_SIDED_STARTS
#include "common/look.glsl"
#include "common/ray_mesh.glsl"
#include "common/shown_maps.glsl"
#include "common/lobe.glsl"
#include "common/shown_pixels.glsl"
#include "common/walk.glsl"
#include "common/surface_change.glsl"
#ifdef EXTENDED
#include "common/shown_coating.glsl"
#endif

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image2D reflected;   // at pixel / STEP; rgb radiance times fraction; a: fraction of the lobe
#include "common/camera.glsl"
#pragma switch OBJECT_RAYS
#ifdef OBJECT_RAYS
layout(rgba16f) readonly uniform image2D object_rays;   // objects, by rays: radiance times fraction; a: fraction of the lobe
const float OBJECTS_BY_RAYS = RAY_ROUGHNESS;            // of smoother surfaces
#else
const float OBJECTS_BY_RAYS = -1.0;
#endif

#ifdef REUSES
#include "common/reflection_history.glsl"
#endif

const float CLEAR = 1e-3;   // of the depth: distance of a ray's start from its own surface

// Radiance times fraction of one cone, through everything that it may hit. With `objects_apart` a cone that meets an object first
// tells nothing (`is_open` false).
vec4 look(vec3 from, vec3 d, float spread, bool objects_apart, out bool is_open) {
    ScreenHit hit = screen_hit(from, d, spread);
    bool found = hit.fraction > 0.0;
    is_open = !(found || objects_apart) || !is_blocked(Ray(from, d), found ? hit.distance : FARTHEST);
    if (objects_apart && !is_open) return vec4(0.0);
    vec4 seen = found && is_open ? shown_at(hit, spread) : vec4(0.0);
#ifdef VOXELS
    float open;
    if (seen.a < 1.0) seen += (1.0 - seen.a) * vec4(look_in_voxels(from, d, spread, open), 1.0);
#endif
    return seen;
}

// Diameter at distance 1 of what one cone represents: its part of the lobe, and the rotation of the reflection across
// the pixel on a curved surface.
float spread_of(float alpha, Change x, Change y) {
    vec2 turned = 2.0 * vec2(length(x.normal), length(y.normal));
    float fraction = 1.0 / float(CONE_COUNT);
    float curved = max(sqrt(turned.x * turned.y * fraction), max(turned.x, turned.y) * fraction);
    return length(vec2(2.0 * MEDIAN_DISC * alpha, curved));
}

// `count` cones spread evenly over the lobe and over the pixel; `of_coat`: of the coat, whose normal that is.
vec4 lobe_reflection(ivec2 pixel, vec4 position, vec4 normal, float roughness, bool of_coat, int count_of_cones) {
    float alpha = max(roughness * roughness, LEAST_ALPHA);
    Change x = change_along(pixel, ivec2(1, 0), position, normal, of_coat);
    Change y = change_along(pixel, ivec2(0, 1), position, normal, of_coat);
    float spread = spread_of(alpha, x, y);
    bool objects_apart = roughness < OBJECTS_BY_RAYS, is_open;
    vec4 sum = vec4(0.0);
    float count = 0.0;
    int j = 0;
    do {
        vec3 even = fract(float(j) * vec3(0.6180339887, 0.7548776662, 0.5698402910) + vec3(0.0, 0.5, 0.5));
        vec2 within = even.yz - 0.5;
        vec3 n = normalize(normal.xyz + within.x * x.normal + within.y * y.normal);
        vec3 p = position.xyz + within.x * x.position + within.y * y.position;
        vec3 v = normalize(camera_position - p);
        mat3 basis = basis_around(n);
        vec3 h = basis * visible_normal(vec2(even.x, (float(j) + 0.5) / float(CONE_COUNT)), v * basis, alpha);
        vec3 d = normalize(2.0 * dot(v, h) * h - v);
        if (dot(d, normal.xyz) <= 0.0) continue;
        vec4 seen = look(p + CLEAR * position.w * normal.xyz, d, spread, objects_apart, is_open);
        if (objects_apart && !is_open) continue;
        sum += seen;
        count += 1.0;
    } while (++j < count_of_cones);
    vec4 seen = sum / max(count, 1.0);
#ifdef OBJECT_RAYS
    vec4 objects = imageLoad(object_rays, pixel);
    if (objects_apart) seen = objects + (1.0 - objects.a) * seen;
#endif
    return seen;
}

// Cones through voxels start on that surface from now on.
void start_on_object(vec4 normal) {
#ifdef VOXELS
    start_on(normal.xyz, is_two_sided(int(normal.w)));
#endif
}

// What a pixel shows of an object's surface, and the lobe that it has there.
struct Lobe { vec4 position; vec4 normal; float roughness; bool reflects; bool is_single; };

#ifdef EXTENDED
Lobe lobe_at(ivec2 pixel) {
    ivec2 raster = raster_texel(pixel);
    Material m = coated_material(raster);
    return Lobe(texelFetch(virtual_raster_position, raster, 0), shown_normal(raster, false), m.roughness, true, m.over.coat == 0.0);
}

// The same of a rougher lobe too, by one cone through voxels.
vec4 any_reflection(ivec2 pixel, vec4 position, vec4 normal, float roughness, bool of_coat, bool wanted) {
    if (roughness < ROUGHEST) return lobe_reflection(pixel, position, normal, roughness, of_coat, wanted ? CONE_COUNT : 1);
#ifdef VOXELS
    vec3 d = reflect(normalize(position.xyz - camera_position), normal.xyz);
    float open;
    return vec4(look_in_voxels(position.xyz + CLEAR * position.w * normal.xyz, d, 2.0 * tan(specular_half_angle(roughness)), open), 1.0);
#else
    return vec4(0.0);
#endif
}

vec4 reflection(ivec2 pixel, Lobe lobe) {
    ivec2 raster = raster_texel(pixel);
    Material m = coated_material(raster);
    vec3 fraction = coat_fraction(reflected_towards(m, lobe.normal.xyz, normalize(camera_position - lobe.position.xyz)));
    vec4 base, coat, normal = lobe.normal;
    float roughness = m.roughness;
    bool of_coat = false, wanted = has_interface(m.f0);
    int count = lobe.is_single ? 1 : 2;
    do {   // in a loop, because drivers compile each call of a long function anew
        vec4 seen = any_reflection(pixel, lobe.position, normal, roughness, of_coat, wanted);
        if (of_coat) coat = seen;
        else base = seen;
        normal = shown_normal(raster, true);
        roughness = m.over.roughness;
        of_coat = wanted = true;
    } while (--count > 0);
    if (lobe.is_single) return base;
    return vec4(mix(base.rgb, coat.rgb, fraction), mix(base.a, coat.a, dot(fraction, vec3(1.0 / 3.0))));
}
#else
Lobe lobe_at(ivec2 pixel) {
    ivec2 raster = raster_texel(pixel);
    vec4 normal = texelFetch(virtual_raster_normal, raster, 0);
    MaterialEntry m = materials[int(normal.w)];
    bool shines = m.dielectric.rgb != vec3(0.0) || m.base_color.a > 0.0;
    float roughness = roughness_at(raster, int(normal.w));
    return Lobe(texelFetch(virtual_raster_position, raster, 0), normal, roughness, shines && roughness < ROUGHEST, true);
}

vec4 reflection(ivec2 pixel, Lobe lobe) {
    return lobe_reflection(pixel, lobe.position, lobe.normal, lobe.roughness, false, CONE_COUNT);
}
#endif

#ifdef REUSES
Seen seen_of(Lobe lobe) {
    vec3 v = normalize(lobe.position.xyz - camera_position);
    return Seen(lobe.position, lobe.normal.xyz, reflect(v, lobe.normal.xyz));
}

// Half-angle of all that a pixel reflects.
float half_angle_of(ivec2 pixel, Lobe lobe) {
    Change x = change_along(pixel, ivec2(1, 0), lobe.position, lobe.normal, false);
    Change y = change_along(pixel, ivec2(0, 1), lobe.position, lobe.normal, false);
    float alpha = max(lobe.roughness * lobe.roughness, LEAST_ALPHA);
    return 0.5 * spread_of(alpha, x, y) * sqrt(float(CONE_COUNT));
}
#endif

// Whether a pixel needs no cones: it reflects nothing, or the last frame knows what.
bool is_known(ivec2 pixel, Lobe lobe) {
    if (!lobe.reflects) {
        imageStore(reflected, pixel / STEP, vec4(0.0));
        return true;
    }
#ifdef REUSES
    if (has_history && lobe.is_single && !is_due(pixel / scale)) return carry_record(pixel, seen_of(lobe), half_angle_of(pixel, lobe));
#endif
    return false;
}

void trace(ivec2 pixel, Lobe lobe) {
    start_on_object(lobe.normal);
    vec4 found = reflection(pixel, lobe);
    imageStore(reflected, pixel / STEP, found);
#ifdef REUSES
    if (lobe.is_single) put_traced(pixel, seen_of(lobe), found);
#endif
}

shared uint pending_count;
shared uint pending[64];

// Of the listed pixels: all that show an object, or one for each quad of them (list_quads). A workgroup first finds which of its pixels
// need cones, so that these are traced by threads in a row.
void main() {
    uint lane = gl_LocalInvocationID.x, count = pixels_shown();
    for (uint start = first_item() - lane; start < count; start += items_apart()) {
        if (lane == 0u) pending_count = 0u;
        barrier();
        uint i = start + lane;
        if (i < count && !is_known(shown_pixel(i), lobe_at(shown_pixel(i)))) pending[atomicAdd(pending_count, 1u)] = i;
        barrier();
        if (lane < pending_count) trace(shown_pixel(pending[lane]), lobe_at(shown_pixel(pending[lane])));
        barrier();
    }
}
