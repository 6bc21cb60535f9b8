// Paints every block (level, direction) of a mipmap with a number of its own, or looks one up (the tests' own shader).
#include "common/volume.glsl"

layout(local_size_x = 64) in;
uniform int level;
uniform int direction;
#ifdef PAINT
layout(rgba16f) writeonly uniform image3D mipmap;

void main() {
    int cells = volume_size >> level;
    int i = int(gl_GlobalInvocationID.x);
    if (i >= cells * cells * cells) return;
    ivec3 cell = ivec3(i % cells, (i / cells) % cells, i / (cells * cells));
    imageStore(mipmap, level_base(level, direction) + cell, vec4(float(level * 8 + direction + 1)));
}
#else
uniform sampler3D mipmap;
layout(std430) readonly buffer Places { vec4 places[]; };
layout(std430) writeonly buffer Found { float found[]; };

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i < uint(places.length())) found[i] = volume_sample(mipmap, 0, volume_size, places[i].xyz, level, direction).r;
}
#endif
