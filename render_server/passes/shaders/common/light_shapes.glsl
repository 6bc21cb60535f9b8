// The kinds of lights, and what one sends to a point that nothing hides from it.
#include "common/basis.glsl"

struct Light {
    vec4 place;    // xyz: direction of travel (directional) or position in m; w: kind
    vec4 color;    // rgb: E_perp (directional), intensity I (sphere, spot, punctual) or radiance L (rectangle), camera units
    vec4 shape;    // x: tan(angular radius) (directional), radius in m (sphere, spot); y - z angle: fraction of I (spot);
                   // y + z cos(angle): root of it (punctual)
    vec4 axis_u;   // xyz: half an edge in m (rectangle) or direction of travel on the axis (spot, punctual)
    vec4 axis_v;   // xyz: half the other edge in m (rectangle); x: 1 / range^2, 1/m^2 (punctual)
    vec4 plane;    // of a mirror image: the plane (world) in front of which it shines
    vec4 mirror;   // of a mirror image: F0 rgb, layer of its map of fractions; -1: no image, -2: lamp of an object. color.w: distance, m, up to
                   // which points belong to the plane; shape.w: roughness; axis_u.w: entry of the surface table;
                   // axis_v.w: the light that it is an image of
    vec4 map_u;    // of a mirror image: its map's coordinates of a world point are dot(xyz, p) + w
    vec4 map_v;
    ivec4 views;   // first view and count in the real scene's atlas, first and count in the objects' atlas
};
// A row each, the bits of floats and integers: an image, because software renderers load buffers lane by lane, number by number.
layout(rgba32ui) readonly uniform uimage2D light_rows;

vec4 light_column(int i, int column) { return uintBitsToFloat(imageLoad(light_rows, ivec2(column, i))); }

Light listed_light(int i) {
    return Light(light_column(i, 0), light_column(i, 1), light_column(i, 2), light_column(i, 3), light_column(i, 4), light_column(i, 5),
        light_column(i, 6), light_column(i, 7), light_column(i, 8), ivec4(imageLoad(light_rows, ivec2(9, i))));
}

const float DIRECTIONAL = 0.0, SPHERE = 1.0, SPOT = 2.0, RECTANGLE = 3.0, PUNCTUAL = 4.0;   // kinds
// Of the scene's lights. llvmpipe executes what one kind needs for every light, so that a scene without it does without.
#pragma switch bool has_rectangles
#pragma switch bool has_mirror_images
#pragma switch bool has_object_lamps

bool is_rectangle(Light light) { return has_rectangles && light.place.w == RECTANGLE; }

bool is_image(Light light) { return has_mirror_images && light.mirror.w >= 0.0; }

// Whether it comes with an object: then it shines in rho alone, because the picture was taken without it.
bool is_object_lamp(Light light) { return has_object_lamps && light.mirror.w < -1.5; }

bool is_punctual(Light light) { return has_object_lamps && light.place.w == PUNCTUAL; }

const float GREATEST_IRRADIANCE = 256.0;   // by a light of an object: half floats and fixed-point sums hold that of several

// What the range of a punctual light leaves of it (KHR_lights_punctual, "Range Property"), and the bound of its irradiance; 1 for others.
float within_range(Light light, vec3 p) {
    vec3 d = light.place.xyz - p;
    float distance2 = dot(d, d), part = distance2 * light.axis_v.x;
    float greatest = max(max(light.color.r, light.color.g), max(light.color.b, 1e-20));
    return is_punctual(light) ? clamp(1.0 - part * part, 0.0, 1.0) * min(GREATEST_IRRADIANCE * distance2 / greatest, 1.0) : 1.0;
}

// Fraction of its intensity that a spot emits along d (unit, of travel); 1 for a sphere.
float spot_fraction(Light light, vec3 d) {
    if (is_punctual(light)) {
        float root = clamp(light.shape.y + light.shape.z * dot(light.axis_u.xyz, d), 0.0, 1.0);
        return root * root;
    }
    float angle = 2.0 * asin(min(0.5 * distance(light.axis_u.xyz, d), 1.0));   // exact for small angles too
    return clamp(light.shape.y - light.shape.z * angle, 0.0, 1.0);
}

// Half the angle between a and b (as seen from the receiver) along the normal of their plane.
vec3 edge_term(vec3 a, vec3 b) {
    vec3 across = cross(a, b);
    float sine = length(across);
    return sine < 1e-12 ? vec3(0.0) : across * (0.5 * atan(sine, dot(a, b)) / sine);
}

vec2 corner(int i) { return vec2(((i + 1) & 2) == 0 ? -1.0 : 1.0, (i & 2) == 0 ? -1.0 : 1.0); }

// Vector irradiance of a rectangle of radiance 1 at p above the horizon of n: dot(result, n) is the irradiance
// (Lambert 1760, photometry of polygons; exact). `edges` is 5, the last along the horizon, or 0 for another kind of
// light: llvmpipe leaves a loop early but executes both sides of a branch.
vec3 rectangle_vector(Light light, int edges, vec3 p, vec3 n) {
    mat2x3 axes = mat2x3(light.axis_u.xyz, light.axis_v.xyz);
    vec3 centre = light.place.xyz - p, sum = vec3(0.0), leaves = vec3(0.0), enters = vec3(0.0);
    vec3 a = centre + axes * corner(0);
    for (int i = 1; i <= edges; ++i) {
        vec3 b = centre + axes * corner(i);
        float above_a = dot(n, a), above_b = dot(n, b);
        vec3 crossing = mix(a, b, above_a / (above_a == above_b ? 1.0 : above_a - above_b));
        bool leaving = above_a >= 0.0 && above_b < 0.0, entering = above_a < 0.0 && above_b >= 0.0;
        vec3 from = entering ? crossing : a, to = leaving ? crossing : b;
        if (i == 5) { from = leaves; to = enters; }
        else if (leaving) leaves = crossing;
        else if (entering) enters = crossing;
        if (i == 5 || above_a >= 0.0 || above_b >= 0.0) sum += edge_term(from, to);
        a = b;
    }
    bool before = dot(cross(axes[0], axes[1]), centre) < 0.0;
    return before ? -sum : vec3(0.0);   // seen from the front, the corners run clockwise
}

// E_perp, the irradiance at p across the beam, and the direction towards the light: a surface with normal n receives
// e_perp * dot(n, to_light). A rectangle is one beam along its vector irradiance; its angular radius is that of the
// disc with the same irradiance. Without a normal (0) no horizon clips it.
vec3 unmirrored_light_at(Light light, vec3 p, vec3 n, out vec3 to_light, out float angular_radius) {
    vec3 d = light.place.xyz - p;
    float distance2 = max(dot(d, d), 1e-8);
    if (has_rectangles) {
        vec3 vector = rectangle_vector(light, is_rectangle(light) ? 5 : 0, p, n);
        float e_perp = length(vector);   // for a radiance of 1
        to_light = e_perp > 1e-12 ? vector / e_perp : d * inversesqrt(distance2);
        angular_radius = asin(min(sqrt(e_perp / PI), 1.0));
        if (is_rectangle(light)) return light.color.rgb * e_perp;
    }
    if (light.place.w == DIRECTIONAL) {
        to_light = -light.place.xyz;
        angular_radius = atan(light.shape.x);
        return light.color.rgb;
    }
    to_light = d * inversesqrt(distance2);
    angular_radius = asin(min(light.shape.x * inversesqrt(distance2), 1.0));
    vec3 e_perp = light.color.rgb / distance2 * spot_fraction(light, -to_light);
    return has_object_lamps ? e_perp * within_range(light, p) : e_perp;
}
