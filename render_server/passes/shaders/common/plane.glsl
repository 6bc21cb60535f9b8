// A triangle as rays from the camera meet it: their products with u and v, over that with the normal, are the weights of its corners b
// and c; `height` over it is how often the ray is to be taken. Texels of an image hold planes, three each.
#include "common/camera.glsl"
struct Plane { vec3 normal; vec3 u; vec3 v; float height; };

const int PLANES_ROW = 1024;   // triangles in a row of the image

Plane plane_of(vec3 a, vec3 b, vec3 c) {
    vec3 ab = b - a, ac = c - a, from_camera = a - camera_position, normal = cross(ab, ac);
    return Plane(normal, cross(ac, from_camera), cross(from_camera, ab), dot(from_camera, normal));
}

ivec2 plane_texel(uint triangle, int part) {
    return ivec2(3 * int(triangle % uint(PLANES_ROW)) + part, int(triangle / uint(PLANES_ROW)));
}
