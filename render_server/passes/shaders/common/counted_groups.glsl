// The workgroups that walk a list whose length only the GPU knows, `per_group` items each, in rows (common/walk.glsl).
#include "common/work_list.glsl"
layout(std430) writeonly buffer Groups { uint groups[3]; };
uniform uint per_group;

void count_groups() {
    uint count = (listed_count() + per_group - 1u) / per_group;
    groups[0] = min(count, GROUPS_IN_ROW);
    groups[1] = (count + GROUPS_IN_ROW - 1u) / GROUPS_IN_ROW;
    groups[2] = 1u;
}
