// Triangles of a mesh as rays from the camera meet them.
#include "common/camera.glsl"
#include "common/solid_mesh.glsl"
#ifdef SOFTWARE
// Three texels a triangle in rows: an image, because software renderers load buffers lane by lane, number by number.
layout(rgba32f) readonly uniform image2D mesh_corners;
const uint CORNERS_ROW = 1024u;   // triangles in a row

mat3 corners_of(uint triangle) {
    ivec2 at = ivec2(3u * (triangle % CORNERS_ROW), triangle / CORNERS_ROW);
    return mat3(imageLoad(mesh_corners, at).xyz, imageLoad(mesh_corners, at + ivec2(1, 0)).xyz, imageLoad(mesh_corners, at + ivec2(2, 0)).xyz);
}
#else
vec3 corner_of(uint number) { return vertex_vector(indices[number] * VERTEX_FLOATS); }

mat3 corners_of(uint triangle) {
    return mat3(corner_of(3u * triangle), corner_of(3u * triangle + 1u), corner_of(3u * triangle + 2u));
}
#endif

// A ray's products with u and v, over that with the normal, are the weights of the corners b and c; `height` over it is how often the
// ray is to be taken.
struct Plane { vec3 normal; vec3 u; vec3 v; float height; };

Plane plane_of(mat3 corners) {
    vec3 from_camera = corners[0] - camera_position, ab = corners[1] - corners[0], ac = corners[2] - corners[0], normal = cross(ab, ac);
    return Plane(normal, cross(ac, from_camera), cross(from_camera, ab), dot(from_camera, normal));
}
