// The fragment of a mesh's triangle where a ray from the camera meets it (Moeller and Trumbore 1997; all rays share their origin).
#include "common/fragment.glsl"
#include "common/solid_mesh.glsl"
#include "common/plane.glsl"
#ifdef MATERIAL_MAPS
// Of the vertices, none of meshes without: second texture coordinate, tangent (scene/gpu_mesh.py).
layout(std430) readonly buffer MapPlacement { float placement[]; };
const uint PLACEMENT_FLOATS = 6u;
#endif

vec3 corner_weights(Plane plane, vec3 ray) {
    vec2 uv = vec2(dot(ray, plane.u), dot(ray, plane.v)) / dot(ray, plane.normal);
    return vec3(1.0 - uv.x - uv.y, uv);
}

uvec3 vertices_of(uint triangle) { return uvec3(indices[3u * triangle], indices[3u * triangle + 1u], indices[3u * triangle + 2u]); }

mat3 corner_vectors(uvec3 corners, uint column) {
    uvec3 at = corners * VERTEX_FLOATS + column;
    return mat3(vertex_vector(at.x), vertex_vector(at.y), vertex_vector(at.z));
}

#ifdef MATERIAL_MAPS
vec2 second_uv_of(uint vertex) {
    uint i = PLACEMENT_FLOATS * vertex;
    return i < uint(placement.length()) ? vec2(placement[i], placement[i + 1u]) : vec2(0.0);
}

vec4 tangent_of(uint vertex) {
    uint i = PLACEMENT_FLOATS * vertex + 2u;
    if (i >= uint(placement.length())) return vec4(0.0);
    return vec4(placement[i], placement[i + 1u], placement[i + 2u], placement[i + 3u]);
}

// `right`, `down`: what a pixel adds to the ray.
void find_maps(inout Fragment f, uvec3 corners, mat3 places, mat3 uv, Plane plane, vec3 weights, vec3 ray, vec3 right, vec3 down) {
    mat3x2 second = mat3x2(second_uv_of(corners.x), second_uv_of(corners.y), second_uv_of(corners.z));
    vec3 beside = corner_weights(plane, ray + right) - weights, below = corner_weights(plane, ray + down) - weights;
    f.second_uv = second * weights;
    f.tangent = mat3x4(tangent_of(corners.x), tangent_of(corners.y), tangent_of(corners.z)) * weights;
    f.uv_slopes = vec4((uv * beside).xy, (uv * below).xy);
    f.second_uv_slopes = vec4(second * beside, second * below);
    f.right = places * beside;
    f.down = places * below;
}
#endif

// Where `ray`, whose length along the optical axis is 1, meets a triangle; `right`, `down`: what a pixel adds to it.
Fragment fragment_at(uint triangle, vec3 ray, vec3 right, vec3 down) {
    uvec3 corners = vertices_of(triangle);
    mat3 places = corners_of(triangle), uv = corner_vectors(corners, 6u);
    Plane plane = plane_of(places);
    vec3 weights = corner_weights(plane, ray);
    float towards = dot(ray, plane.normal);
    Fragment f;
    f.depth = plane.height / towards;
    f.world = camera_position + f.depth * ray;
    f.normal = corner_vectors(corners, 3u) * weights;
    f.face = plane.normal * (towards > 0.0 ? -1.0 : 1.0) / max(length(plane.normal), 1e-30);
    f.uv = (uv * weights).xy;
    f.tint = corner_vectors(corners, 8u) * weights;
    f.material = material_of(triangle);
    f.is_back = towards > 0.0;
#ifdef CUTOUTS
    uvec3 last = corners * VERTEX_FLOATS + 11u;
    f.opacity = opacity_of_vertices(dot(weights, fract(vec3(vertices[last.x], vertices[last.y], vertices[last.z]))));
#endif
#ifdef MATERIAL_MAPS
    find_maps(f, corners, places, uv, plane, weights, ray, right, down);
#endif
    return f;
}
