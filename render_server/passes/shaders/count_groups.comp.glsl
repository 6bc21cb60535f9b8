// Counts the workgroups that walk a list.
#include "common/counted_groups.glsl"

layout(local_size_x = 1) in;

void main() { count_groups(); }
