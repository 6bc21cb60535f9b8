// Lists the triangles of a mesh that have backs: all but those where a camera sees that nothing is at the middle of the back.
#include "common/solid_mesh.glsl"
#include "common/depth_views.glsl"

layout(local_size_x = 64) in;
uniform float behind;         // m
uniform int first_triangle, triangle_count, first_chosen;
layout(std430) writeonly buffer Chosen { uint chosen[]; };   // the triangle's number, from the first one on, or NOT_CHOSEN

void main() {
    uint triangle = gl_GlobalInvocationID.x;
    if (triangle >= uint(triangle_count)) return;
    Piece back = triangle_at(uint(first_triangle) + triangle, behind);
    vec3 middle = (back.a.place + back.b.place + back.c.place) / 3.0;
    chosen[uint(first_chosen) + triangle] = is_in_free_space(middle) ? NOT_CHOSEN : triangle;
}
