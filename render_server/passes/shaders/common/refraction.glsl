// Light at the surfaces of transparent objects (docs/method.md 4.11): Snell, Fresnel, total reflection. Needs brdf.glsl and ray_mesh.glsl.
#ifdef EXTENDED
#include "common/coating.glsl"
#endif

// A surface that a ray meets: normals against the ray, of the mesh as it is smoothed and of the triangle itself.
struct Interface {
    vec3 position; vec3 normal; vec3 face; int material; Material surface;
#ifdef FOOTPRINTS
    mat2x3 turn;   // of the normal, over the ray's footprint
#endif
};

const float SKIN = 2e-5;         // of the coordinates: distance of a ray's start from the surface that it leaves
const float THINNEST = 1e-6;     // m: the same, at least

// `size`: of the footprint there, m.
Interface interface_at(MeshHit hit, Ray ray, float size) {
    int at = 3 * hit.triangle;
    ivec3 rows = floatBitsToInt(vec3(face_at(at).w, face_at(at + 1).w, face_at(at + 2).w));
    vec3 weights = vec3(1.0 - hit.place.x - hit.place.y, hit.place);
    vec3 face = normalize(cross(face_at(at + 1).xyz, face_at(at + 2).xyz));
    if (dot(face, ray.direction) > 0.0) face = -face;
    vec3 normal = vertex_vector(rows, 3, weights);
    if (dot(normal, face) < 0.0) normal = -normal;
    // Smooth normals lean beyond the horizon at silhouettes, where the surface is seen edge on.
    normal = dot(normal, ray.direction) < 0.0 ? normalize(normal) : face;
    int index = int(vertices[rows.x * VERTEX_FLOATS + 11]);
    vec2 uv = vertex_vector(rows, 6, weights).xy;
    Material surface = material_of(index, uv, vertex_vector(rows, 8, weights), size);
    Interface i;
    i.position = ray.from + hit.distance * ray.direction;
    i.normal = normal;
    i.face = face;
    i.material = index;
    i.surface = surface;
    return i;
}

// Where a ray in direction d starts from the surface.
vec3 leave(Interface i, vec3 d) {
    vec3 a = abs(i.position);
    float skin = max(SKIN * max(max(a.x, a.y), a.z), THINNEST);
    return i.position + (dot(d, i.face) > 0.0 ? skin : -skin) * i.face;
}

// Index of refraction relative to what is beyond the surface, for a ray from inside or outside of the solid; 1: thin.
float relative_index(Interface i, bool inside) {
    float ior = materials[i.material].medium.w;
    return ior == 0.0 ? 1.0 : (inside ? ior : 1.0 / ior);
}

// What a surface reflects of light that comes from outside or inside; all channels alike unless it is tinted.
vec3 interface_reflectance(Interface i, vec3 d, bool inside) {
    float cosine = -dot(i.normal, d);
    if (inside) return vec3(fresnel_dielectric(cosine, relative_index(i, true)));
    vec3 base = specular_reflectance(i.surface.f0, i.surface.roughness, cosine);
#ifdef EXTENDED
    return 1.0 - reflected_towards(i.surface, i.normal, -d).below * (1.0 - base);
#else
    return base;
#endif
}

// The refracted direction; it goes on beyond the triangle, too, where the smooth normal is another one. Not for total reflection.
vec3 refracted(Interface i, vec3 d, bool inside) {
    float eta = relative_index(i, inside);
    vec3 bent = eta == 1.0 ? d : refract(d, i.normal, eta);
    return dot(bent, i.face) < 0.0 ? bent : d;
}

vec3 mirrored(Interface i, vec3 d) {
    vec3 back = reflect(d, i.normal);
    return dot(back, i.face) > 0.0 ? back : reflect(d, i.face);
}

// What is left of light after a path inside a material; -1: outside of all.
vec3 kept_over(int medium, float path) { return medium < 0 ? vec3(1.0) : exp(-materials[medium].medium.rgb * path); }

bool is_transparent(int material) { return materials[material].emission.a > 0.0 && materials[material].base_color.a < 1.0; }
