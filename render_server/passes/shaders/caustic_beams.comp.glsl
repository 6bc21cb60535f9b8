// Beams of light that smooth virtual surfaces reflect: the flux of each block of a light's map of the objects is
// split over a few rays, each traced to the first object that it meets. WIDE: they sample the GGX lobe; otherwise all
// go in the mirror direction. REFRACTED: they go through transparent objects, along the strongest of the paths into
// which surfaces divide each ray.
#include "common/light_rays.glsl"
#include "common/brdf.glsl"
#include "common/geometry.glsl"
#define MEETS_BACKS   // what is not seen from behind reflects light and casts shadows all the same
#include "common/ray_mesh.glsl"
#include "common/ray_pattern.glsl"
#include "common/lobe.glsl"
#include "common/packing.glsl"
#ifdef EXTENDED
#include "common/coating.glsl"
#endif
#ifdef REFRACTED
#include "common/refraction.glsl"
#endif
#define APPENDS_SENT_BEAMS
#include "common/sent_beams.glsl"

#include "common/pixel_group.glsl"
uniform sampler2D object_rsm_uv;
uniform sampler2D object_rsm_normal;
#pragma texels rgba32f object_rsm_uv
#pragma texels rgba16f object_rsm_normal
uniform int view_index;
uniform int block_edge;        // texels
uniform float least_alpha;     // for materials with lobes of at least this width,
uniform float greatest_alpha;  // and below this one
uniform float bias_real;       // m
uniform float normal_offset;   // m: away from the object's own triangles

#ifdef WIDE
const float LOBE_FRACTION = 0.5;    // a ray represents part of its lobe: this wide, so that together they are little wider
#else
const float LOBE_FRACTION = 1.0;    // all go in the mirror direction, and are as wide as the lobe
#endif
const float RAYS_APART = inversesqrt(float(RAY_COUNT));   // of a block's edge
// Standard deviation of the normal distribution with the peak of a GGX lobe cut off at 85 % of its energy;
// half-vectors turn half as far as the directions they reflect.
const float LOBE_DEVIATION = 2.0 * 0.65;
const float ALIKE = 0.5;            // cosine between normals of neighbours on one smooth surface

struct Spot { bool present; vec3 point; vec3 normal; vec3 seen_from; int material; };   // seen_from: direction of the light

Spot spot_at(LightView view, ivec2 texel) {
    Spot spot = Spot(false, vec3(0.0), vec3(0.0), vec3(0.0), -1);
    vec2 inside = vec2(texel) - view.tile.xy;
    if (any(lessThan(inside, vec2(0.0))) || any(greaterThanEqual(inside, view.tile.zz))) return spot;
    float depth = first_depth(object_rsm_depth, view, texel);
    if (depth == NOTHING) return spot;
    vec4 normal = texelFetch(object_rsm_normal, texel, 0);
    vec2 s = texel_lateral(view, texel);
    spot.point = ray_point(view, s, depth);
    spot.seen_from = normalize(ray_point(view, s, 2.0) - ray_point(view, s, 1.0));
    spot.normal = dot(normal.xyz, spot.seen_from) > 0.0 && materials[int(normal.w)].flags.x > 0.5 ? -normal.xyz : normal.xyz;
    // Smooth normals lean beyond the horizon at silhouettes, where the surface is seen edge on.
    float facing = dot(spot.normal, -spot.seen_from);
    spot.normal = normalize(spot.normal - max(1e-2 - facing, 0.0) * spot.seen_from);
    spot.material = int(normal.w);
    spot.present = true;
    return spot;
}

#ifdef MATERIAL_MAPS
bool is_wanted(ivec2 texel, int material) {
    vec4 uv = texelFetch(object_rsm_uv, texel, 0);
    Material m = material_of(material, uv.xy, unpack_color(uv.z), 0.0);
    float alpha = m.roughness * m.roughness;
    return alpha >= least_alpha && alpha < greatest_alpha && has_interface(m.f0);
}
#else
bool is_wanted(ivec2 texel, int material) {
    vec4 dielectric = materials[material].dielectric;
    float alpha = dielectric.a * dielectric.a;
    bool smooth_enough = alpha >= least_alpha && alpha < greatest_alpha;
    return smooth_enough && (materials[material].base_color.a > 0.0 || has_interface(dielectric.rgb));
}
#endif

// Of a mirror's ray from this texel to the next block along `axis`.
RayDifferential mirrored_differential(LightView view, ivec2 texel, ivec2 axis, Spot here, float side) {
    int neighbour_texels = max(block_edge / 2, 1);
    vec3 own = reflect(here.seen_from, here.normal);
    for (int sign = 1; sign >= -1; sign -= 2) {
        Spot other = spot_at(view, texel + sign * neighbour_texels * axis);
        if (!other.present || other.material != here.material || dot(other.normal, here.normal) < ALIKE) continue;
        float blocks = float(sign * block_edge) / float(neighbour_texels) * RAYS_APART;
        return RayDifferential(blocks * (other.point - here.point), blocks * (reflect(other.seen_from, other.normal) - own));
    }
    vec3 across = transpose(mat3(view.view_from_world)) * vec3(vec2(axis), 0.0) * side * float(block_edge) * RAYS_APART;
    return RayDifferential(across, vec3(0.0));   // alone in its block: treated as flat
}

// Fraction of a lobe's ray that is not lost between microfacets (Heitz 2014), for visible normals.
float unmasked(float n_dot_v, float n_dot_l, float alpha) {
    vec2 c = vec2(n_dot_v, n_dot_l);
    vec2 lambda = 0.5 * (sqrt(1.0 + alpha * alpha * (1.0 / (c * c) - 1.0)) - 1.0);
    return (1.0 + lambda.x) / (1.0 + lambda.x + lambda.y);
}

// `hit`: where it ends.
void send(vec3 from, vec3 direction, MeshHit hit, vec3 flux, float spread, RayDifferential x, RayDifferential y) {
    SentBeam beam = SentBeam(vec4(from, hit.triangle < 0 ? 1e30 : hit.distance), vec4(direction, spread), vec4(flux, 0.0),
        vec4(x.start, 0.0), vec4(x.turn, 0.0), vec4(y.start, 0.0), vec4(y.turn, 0.0));
    uint at = atomicAdd(sent_count, 1u);
    if (at < uint(sent_beams.length())) sent_beams[at] = beam;
}

ivec2 texel_of_ray(LightView view, ivec2 block, vec4 numbers) {
    return ivec2(view.tile.xy) + ivec2((vec2(block) + numbers.zw) * float(block_edge));
}

#ifdef REFRACTED
const int MOST_SURFACES = 24;    // that the paths of one ray meet
const int LONGEST_WAY = 16;      // surfaces that one of them meets
const int HELD = 4;              // paths that wait
const float LEAST_PART = 0.01;   // of the light, that a path must keep
const float LAMP_FRACTION = 0.5; // a ray represents part of its lamp: this wide

// A path through transparent objects: where it goes on, and what is left of its light. `ways`: whether it was reflected (1) or went
// on (0) at each surface, after a leading 1; 0 where there is no such path. `medium`: the material that it is in, -1 for none.
// `bent`: how far rough surfaces turn it, relative to a mirror's lobe.
struct Passage { uint ways; vec3 from; vec3 direction; vec3 part; float bent; int medium; };

Passage held[HELD];
int held_count;

float greatest(vec3 c) { return max(max(c.r, c.g), c.b); }

void hold(Passage way) {
    if (held_count < HELD && greatest(way.part) >= LEAST_PART) held[held_count++] = way;
}

Passage strongest_held() {
    int best = 0;
    for (int k = 1; k < held_count; ++k)
        if (greatest(held[k].part) > greatest(held[best].part)) best = k;
    Passage way = held[best];
    held[best] = held[--held_count];
    return way;
}

// Of a ray: where its lamp's light starts, relative to the lamp's middle and to the distance; the depth in the light's view at which
// rays from all over the lamp through one place of the view meet; and the spacing of rays from that part of the lamp, in blocks.
struct LampPart { vec3 aside; float depth; float ray_spacing; };

Passage first_passage(LightView view, vec2 s, LampPart part) {
    vec3 meeting = ray_point(view, s, part.depth);
    vec3 direction = normalize(normalize(ray_point(view, s, 2.0) - ray_point(view, s, 1.0)) - part.aside);
    float back = view.range.z > 0.5 ? part.depth : part.depth - view.range.x;
    return Passage(1u, meeting - back * direction, direction, vec3(1.0), 0.0, -1);
}

bool meets_transparent(MeshHit hit) { return hit.triangle >= 0 && is_transparent(material_of_triangle(max(hit.triangle, 0))); }

// A surface that a path meets, what it reflects of it, and how far away it is.
struct Meeting { Interface surface; vec3 reflectance; float distance; };

Meeting meeting(Passage way, MeshHit hit) {
    Interface i = interface_at(hit, Ray(way.from, way.direction), 0.0);
    return Meeting(i, interface_reflectance(i, way.direction, way.medium >= 0), hit.distance);
}

// What a surface reflects of a path (`back`) or lets on; its part is 0 if there is no such path.
Passage divided(Passage way, Meeting met, bool back) {
    Interface i = met.surface;
    bool inside = way.medium >= 0;
    way.part *= kept_over(way.medium, met.distance) * (back ? met.reflectance : (1.0 - met.reflectance) * i.surface.passing);
    float index = max(materials[i.material].medium.w, 1.0), alpha = i.surface.roughness * i.surface.roughness;
    way.bent = length(vec2(way.bent, alpha * (back ? (inside ? index : 1.0) : 0.5 * (index - 1.0))));
    if (!back) way.medium = inside || materials[i.material].medium.w == 0.0 ? -1 : i.material;
    way.direction = back ? mirrored(i, way.direction) : refracted(i, way.direction, inside);
    way.from = leave(i, way.direction);
    way.ways = way.ways << 1u | (back ? 1u : 0u);
    return way;
}

// The path by the same ways from another place of the light's view.
Passage along_ways(LightView view, vec2 s, LampPart part, uint ways) {
    Passage way = first_passage(view, s, part);
    for (int k = findMSB(ways) - 1; k >= 0; --k) {
        MeshHit hit = closest_hit(Ray(way.from, way.direction));
        if (meets_transparent(hit)) way = divided(way, meeting(way, hit), (ways >> uint(k) & 1u) != 0u);
        else way.part = vec3(0.0);
        if (way.part == vec3(0.0)) { way.ways = 0u; break; }
    }
    return way;
}

// Of a path from this texel to the next block along `axis`.
RayDifferential refracted_differential(LightView view, ivec2 texel, ivec2 axis, LampPart part, Passage here, float side) {
    int neighbour_texels = max(block_edge / 2, 1);
    for (int sign = 1; sign >= -1; sign -= 2) {
        Passage other = along_ways(view, texel_lateral(view, texel + sign * neighbour_texels * axis), part, here.ways);
        if (other.ways != here.ways) continue;
        float blocks = float(sign * block_edge) / float(neighbour_texels) * part.ray_spacing;
        return RayDifferential(blocks * (other.from - here.from), blocks * (other.direction - here.direction));
    }
    vec3 across = transpose(mat3(view.view_from_world)) * vec3(vec2(axis), 0.0) * side * float(block_edge) * part.ray_spacing;
    return RayDifferential(across, vec3(0.0));
}

void leave_objects(LightView view, ivec2 texel, float side, LampPart part, Passage way, MeshHit hit, vec3 flux, float radius) {
    RayDifferential x, y;
    int axis = 0;
    do {   // in a loop, because drivers compile each call of a long function anew
        RayDifferential differential = refracted_differential(view, texel, ivec2(1 - axis, axis), part, way, side);
        if (axis == 0) x = differential;
        else y = differential;
    } while (++axis < 2);
    send(way.from, way.direction, hit, flux * way.part, length(vec2(LOBE_DEVIATION * way.bent, 0.5 * LAMP_FRACTION * radius)), x, y);
}

// Sends a beam for each of the strongest PATHS paths of a ray; what its first surface reflects, mirrors' beams bring.
void send_paths(LightView view, ivec2 texel, float side, LampPart part, vec3 flux, float radius) {
    held_count = 0;
    hold(first_passage(view, texel_lateral(view, texel), part));
    int sent = 0;
    for (int k = 0; k < MOST_SURFACES && held_count > 0 && sent < PATHS; ++k) {
        Passage way = strongest_held();
        MeshHit hit = closest_hit(Ray(way.from, way.direction));
        bool is_first = way.ways == 1u;
        if (!meets_transparent(hit)) {
            if (is_first) return;
            leave_objects(view, texel, side, part, way, hit, flux, radius);
            ++sent;
        } else if (findMSB(way.ways) < LONGEST_WAY) {
            Meeting met = meeting(way, hit);
            hold(divided(way, met, false));
            if (!is_first) hold(divided(way, met, true));
        }
    }
}

bool lets_through(int material) {
    float roughness = materials[material].dielectric.a;
    return is_transparent(material) && roughness * roughness < greatest_alpha;
}

void cast_ray(Light light, LightView view, ivec2 block, int j) {
    vec4 numbers = ray_numbers(block, j);
    ivec2 texel = texel_of_ray(view, block, numbers);
    Spot spot = spot_at(view, texel);
    if (!spot.present || !lets_through(spot.material)) return;
    vec3 to_light; float radius;
    light_at(light, spot.point, spot.normal, to_light, radius);
    vec2 s = texel_lateral(view, texel);
    vec3 flux = float(block_edge * block_edge) / float(RAY_COUNT) * texel_light(light, view, s);
    if (flux == vec3(0.0)) return;
    flux *= within_range(light, spot.point) * real_visibilities(light, spot.point, spot.normal, bias_real).y;
    float depth = (view.view_from_world * vec4(spot.point, 1.0)).z, angle = 2.0 * PI * numbers.x;
    vec2 on_lamp = tan(radius) * sqrt(numbers.y) * vec2(cos(angle), sin(angle));
    // Over the length of the objects a lamp spreads light by so many blocks; rays of a small one share a block.
    float ray_spacing = clamp(radius * view.tile.z / float(block_edge), RAYS_APART, 1.0);
    LampPart part = LampPart(transpose(mat3(view.view_from_world)) * vec3(on_lamp, 0.0), depth, ray_spacing);
    send_paths(view, texel, texel_side(view, depth), part, flux, radius);
}
#else
// Ray j of a block: its texel is one of RAY_COUNT spread evenly over the block, which share the block's flux.
void cast_ray(Light light, LightView view, ivec2 block, int j) {
    vec4 numbers = ray_numbers(block, j);
    ivec2 texel = texel_of_ray(view, block, numbers);
    Spot spot = spot_at(view, texel);
    if (!spot.present || !is_wanted(texel, spot.material)) return;
    vec3 to_light; float radius;
    light_at(light, spot.point, spot.normal, to_light, radius);
    float fraction = float(block_edge * block_edge) / float(RAY_COUNT);
    vec3 flux = fraction * texel_light(light, view, texel_lateral(view, texel));
    if (flux == vec3(0.0)) return;
    flux *= within_range(light, spot.point) * real_visibilities(light, spot.point, spot.normal, bias_real).y;
    vec4 uv = texelFetch(object_rsm_uv, texel, 0);
    Material m = material_of(spot.material, uv.xy, unpack_color(uv.z), 0.0);
    float alpha = max(m.roughness * m.roughness, LEAST_ALPHA);
    vec3 v = -spot.seen_from, h = spot.normal;
#ifdef WIDE
    mat3 basis = basis_around(spot.normal);
    h = basis * visible_normal(numbers.xy, v * basis, alpha);
#endif
    vec3 direction = reflect(-v, h);
    float n_dot_l = dot(spot.normal, direction);
    if (n_dot_l <= 0.0) return;
    flux *= fresnel_schlick(m.f0, dot(v, h)) * unmasked(dot(spot.normal, v), n_dot_l, alpha)
        * further_reflections(m.f0, lobe_albedo(m.roughness, dot(spot.normal, v)).x);
#ifdef EXTENDED
    flux *= reflected_towards(m, spot.normal, direction).below;
#endif
    float spread = length(vec2(LOBE_DEVIATION * alpha * LOBE_FRACTION, 0.5 * radius));   // half a disc's radius
    float side = texel_side(view, (view.view_from_world * vec4(spot.point, 1.0)).z);
    RayDifferential x = mirrored_differential(view, texel, ivec2(1, 0), spot, side);
    RayDifferential y = mirrored_differential(view, texel, ivec2(0, 1), spot, side);
    vec3 from = spot.point + normal_offset * spot.normal;
    send(from, direction, closest_hit(Ray(from, direction)), flux, spread, x, y);
}
#endif

void main() {
    LightView view = listed_view(view_index);
    ivec3 at = ivec3(gl_GlobalInvocationID);
    Light light = listed_light(light_of_view(view_index));
    if (any(greaterThanEqual(at.xy * block_edge, ivec2(view.tile.zz))) || is_image(light)) return;
    cast_ray(light, view, at.xy, at.z);
}
