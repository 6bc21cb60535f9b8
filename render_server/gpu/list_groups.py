"""Workgroups for lists whose length only the GPU knows."""

import moderngl

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import common_kernel

LIST_HEADER_BYTES = 4  # of shaders/common/work_list.glsl: the number of items
GROUPS_BYTES = 12


class ListGroups:
    """Counts the workgroups that walk a list of shaders/common/work_list.glsl, for `Kernel.run_counted`."""

    def __init__(self, gpu: GpuContext, per_group: int) -> None:
        self._per_group = per_group
        self._groups = gpu.ctx.buffer(reserve=GROUPS_BYTES)
        self._kernel = common_kernel(gpu, "count_groups")

    def count(self, texels: moderngl.Buffer) -> moderngl.Buffer:
        """Returns the workgroups (x, y, z) that `per_group` items each need; valid until the next call."""
        self._kernel.run((1,), Texels=texels, Groups=self._groups, per_group=self._per_group)
        return self._groups

    def release(self) -> None:
        """Frees the buffer."""
        self._groups.release()
