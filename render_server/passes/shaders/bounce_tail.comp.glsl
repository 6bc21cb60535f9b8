// Sums up the bounces beyond those that the voxels hold, a workgroup for each volume: where gather_voxels does not.
const int THREADS = 256;   // = local_size_x
layout(local_size_x = 256) in;
#include "common/bounce_tail.glsl"
#include "common/tail_sums.glsl"

void main() { sum_tail(int(gl_WorkGroupID.x), int(gl_LocalInvocationID.x)); }
