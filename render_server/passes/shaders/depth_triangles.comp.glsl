// Joins neighbouring nodes of a depth image's meshes, fine (z: 0) and coarse (1), that lie on one surface: two triangles for each
// quad of nodes, of which those that are not there have no area (scene/depth_mesh.py). Seen from the camera, they are
// counter-clockwise. A triangle goes if others show all of its corners larger, so that meshes of several cameras overlap where
// they meet.
#include "common/pixel_group.glsl"
#include "common/node_grids.glsl"
uniform sampler2D nodes;         // as depth_nodes leaves them
uniform vec2 node_slopes;        // what w may change from node to node, per w
uniform float least_step;        // and at least
uniform ivec2 first_triangles;
layout(std430) writeonly buffer Indices { uint indices[]; };

int coarseness;   // of this mesh
vec3 corner[4];   // 0 1 above 2 3: w, slack, whether another camera shows it larger

// A grazing surface has no step but what its slope explains.
bool joined(int one, int other) {
    float measured = corner[0].y > 0.0 ? 0.0 : corner[0].x;
    float limit = measured * node_slopes[coarseness] + least_step + corner[one].y + corner[other].y;
    return abs(corner[one].x - corner[other].x) <= limit;
}

// Whether the triangle of these corners is there, if the quad is cut from `a` to `b`.
bool on_one_surface(int a, int b, int c) {
    bool usable = min(corner[a].x, min(corner[b].x, corner[c].x)) > 0.0;
    bool is_copy = min(corner[a].z, min(corner[b].z, corner[c].z)) > 0.5;
    return usable && !is_copy && joined(a, b) && joined(a, c) && joined(b, c);
}

// Whether the quad is cut from 0 to 3: along the lesser step, and between the neighbours of a hole.
bool is_cut_from_0_to_3() {
    bool falling = abs(corner[0].x - corner[3].x) <= abs(corner[1].x - corner[2].x);
    falling = falling || corner[1].x == 0.0 || corner[2].x == 0.0;
    return falling && corner[0].x > 0.0 && corner[3].x > 0.0;
}

void main() {
    coarseness = int(gl_WorkGroupID.z);
    ivec2 quad = ivec2(gl_GlobalInvocationID.xy), size = grid_size(coarseness);
    if (any(greaterThanEqual(quad, size - 1))) return;
    for (int i = 0; i < 4; ++i) corner[i] = texelFetch(nodes, node_texel(coarseness, quad + ivec2(i & 1, i >> 1)), 0).xyz;
    bool falling = is_cut_from_0_to_3();
    ivec3 first = falling ? ivec3(0, 2, 3) : ivec3(0, 2, 1), second = falling ? ivec3(0, 3, 1) : ivec3(1, 2, 3);
    bool has_first = on_one_surface(first.x, first.y, first.z), has_second = on_one_surface(second.x, second.y, second.z);
    uint node = uint(first_vertices[coarseness] + quad.y * size.x + quad.x), row = uint(size.x);
    uint at = 3u * uint(first_triangles[coarseness]) + 6u * uint(quad.y * (size.x - 1) + quad.x);
    for (int i = 0; i < 3; ++i) {
        indices[at + uint(i)] = has_first ? node + uint(first[i] & 1) + row * uint(first[i] >> 1) : 0u;
        indices[at + 3u + uint(i)] = has_second ? node + uint(second[i] & 1) + row * uint(second[i] >> 1) : 0u;
    }
}
