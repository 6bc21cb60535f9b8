// Triangles, and the pairs of a triangle and a voxel that it may meet. Needs PAIRS_ACCESS: `readonly`, or empty.
struct Corner { float p[3]; float uv[2]; float tint[3]; float material; float double_sided; };
struct Triangle { Corner corners[3]; };
layout(std430) readonly buffer Triangles { Triangle triangles[]; };
layout(std430) PAIRS_ACCESS buffer Pairs { uint pair_count; uint pairs_pad; uvec2 pairs[]; };   // triangle, packed voxel

vec3 corner_position(Corner c) { return vec3(c.p[0], c.p[1], c.p[2]); }

uvec2 pair_of(uint triangle, ivec3 voxel) { return uvec2(triangle, uint(voxel.x | voxel.y << 10 | voxel.z << 20)); }

ivec3 voxel_of_pair(uvec2 pair) { return ivec3(pair.y & 1023u, pair.y >> 10 & 1023u, pair.y >> 20); }
