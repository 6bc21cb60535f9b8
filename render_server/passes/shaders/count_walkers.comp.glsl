// Counts the workgroups, all in one row, that walk a list of which each takes `per_group` items (common/walk.glsl).
#include "common/work_list.glsl"

layout(local_size_x = 1) in;
layout(std430) writeonly buffer Groups { uint groups[3]; };
uniform uint per_group;

const uint MOST_IN_ROW = 65535u;   // OpenGL guarantees no more; walkers of more items take several in turn

void main() {
    groups[0] = min((listed_count() + per_group - 1u) / per_group, MOST_IN_ROW);
    groups[1] = groups[2] = 1u;
}
