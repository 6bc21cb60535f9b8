"""Threads and workgroups for lists whose length only the GPU knows."""

import moderngl

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings, Kernel, common_kernel

LIST_HEADER_BYTES = 4  # of shaders/common/work_list.glsl: the number of items
GROUPS_BYTES = 12
GROUP = 64  # threads of a workgroup that walks a list
SOFTWARE_WALKERS = 1024
# Mesa's software renderer silently ends all loops of a thread after 65535 iterations in total; tracing the
# cones of one texel takes up to about 5000 (16 cones through 256 voxels and the coarse scene). Rays through the
# triangles of transparent objects take thousands each, so a thread traces one, or those of a single pixel.
SOFTWARE_DIVISOR = 12
SOFTWARE_GROUP_ITEMS = 256  # of a workgroup of 64 threads: below SOFTWARE_DIVISOR each
LIST_WALKERS = 16384
MOST_WALKERS = 65535 * 64  # OpenGL guarantees no more workgroups in a row; a dispatch of more does nothing
GPU_WALKERS = 2**18  # 4096 workgroups: what the largest GPUs hold at a time; idle threads cost microseconds


def list_threads(gpu: GpuContext, longest: int | None = None) -> int:
    """Returns the number of threads for walking a list of at most `longest` items; the GPU alone knows how many.

    Few in software, where an idle thread costs as much as a busy one, but enough that no thread's loops are
    cut off.
    """
    if not gpu.is_software:
        return min(longest or GPU_WALKERS, MOST_WALKERS)
    longest = longest or LIST_WALKERS
    return min(longest, max(SOFTWARE_WALKERS, -(-longest // SOFTWARE_DIVISOR)))


def map_threads(gpu: GpuContext, side: int) -> int:
    """Returns the number of threads for walking a square map of `side` texels.

    In software these are whole rows, so that a thread's next texel lies near its last one.
    """
    return side * max(1, SOFTWARE_WALKERS // side) if gpu.is_software else list_threads(gpu, side**2)


class ListGroups:
    """Counts the workgroups that walk a list of shaders/common/work_list.glsl, for `Kernel.run_counted`.

    They lie in rows (`counted_group()`), or in one for kernels that walk as shaders/common/walk.glsl says.
    """

    def __init__(self, gpu: GpuContext, per_group: int, *, in_rows: bool = True) -> None:
        self._per_group = per_group
        self._groups = gpu.ctx.buffer(reserve=GROUPS_BYTES)
        self._kernel = common_kernel(gpu, "count_groups" if in_rows else "count_walkers")

    def count(self, texels: moderngl.Buffer) -> moderngl.Buffer:
        """Returns the workgroups (x, y, z) that `per_group` items each need; valid until the next call."""
        self._kernel.run((1,), Texels=texels, Groups=self._groups, per_group=self._per_group)
        return self._groups

    def release(self) -> None:
        """Frees the buffer."""
        self._groups.release()


class ListWalk:
    """Runs kernels over lists of at most `longest` items, whose length only the GPU knows (shaders/common/walk.glsl).

    In software, by as many workgroups as the items need: each of the others costs up to 40 µs, a long kernel's
    prologue. On a GPU by list_threads(), because there a dispatch that counts costs more than idle threads.
    """

    def __init__(self, gpu: GpuContext, longest: int) -> None:
        self._threads = list_threads(gpu, longest)
        self._groups = ListGroups(gpu, SOFTWARE_GROUP_ITEMS, in_rows=False) if gpu.is_software else None

    def run(self, kernel: Kernel, items: moderngl.Buffer, *shared: Bindings, **own: Binding) -> None:
        """Runs a kernel, 64 threads a workgroup, over `items` (count, then items), which `own` binds too."""
        if self._groups is None:
            kernel.run((self._threads,), *shared, **own)
        else:
            kernel.run_counted(self._groups.count(items), *shared, **own)

    def release(self) -> None:
        """Frees the buffer."""
        if self._groups is not None:
            self._groups.release()
