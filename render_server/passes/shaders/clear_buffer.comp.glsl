// Clears buffers (common/cleared_starts.glsl).
#include "common/cleared_starts.glsl"
layout(local_size_x = 256) in;

void main() { clear_starts(gl_GlobalInvocationID.x, gl_NumWorkGroups.x * 256u); }
