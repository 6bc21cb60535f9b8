"""Buffers of one sparse voxel set (passes/common/voxel_store.glsl)."""

import moderngl
import numpy as np

from render_server.gpu.context import GpuContext

SURFEL_BYTES = 64
SUMS_PER_SLOT = 24
DELTA_SUMS_PER_SLOT = 18
COUNTER_BYTES = 16


class VoxelStore:
    """Slots, surfels and fixed-point sums of the real or of the virtual geometry.

    Buffers grow with the number of surfels that a mesh can make; the grid is as large as the volume.
    """

    def __init__(self, gpu: GpuContext, volume_size: int) -> None:
        self._ctx = gpu.ctx
        self._voxels = volume_size**3
        self.grid = gpu.ctx.buffer(reserve=self._voxels * 4)
        self.grid.clear()
        self.counters = gpu.ctx.buffer(bytes(COUNTER_BYTES))
        self.surfel_capacity = 0
        self.surfels = self.touched = self.sums = self.delta_sums = gpu.ctx.buffer(reserve=16)
        self._grow(1024)

    @property
    def slot_capacity(self) -> int:
        """Greatest number of touched voxels."""
        return min(self.surfel_capacity, self._voxels)

    def _grow(self, surfels: int) -> None:
        """Make room for `surfels` surfels; contents are lost."""
        for buffer in {self.surfels, self.touched, self.sums, self.delta_sums}:
            buffer.release()
        self.surfel_capacity = surfels
        self.surfels = self._ctx.buffer(reserve=surfels * SURFEL_BYTES)
        self.touched = self._ctx.buffer(reserve=self.slot_capacity * 4)
        self.sums = self._ctx.buffer(reserve=self.slot_capacity * SUMS_PER_SLOT * 4)
        self.delta_sums = self._ctx.buffer(reserve=self.slot_capacity * DELTA_SUMS_PER_SLOT * 4)

    def start(self, surfel_bound: int) -> None:
        """Begin a new voxelisation of at most `surfel_bound` surfels (the old voxels were cleared before)."""
        if surfel_bound > self.surfel_capacity:
            self._grow(int(surfel_bound * 1.25) + 1024)
        self.counters.write(np.array([0, 0, self.surfel_capacity, 0], np.uint32).tobytes())

    def bind(self) -> None:
        """Bind to the places that voxel_store.glsl names."""
        buffers = (self.grid, self.touched, self.surfels, self.counters, self.sums)
        for binding, buffer in enumerate(buffers, start=2):
            buffer.bind_to_storage_buffer(binding)

    def counts(self) -> tuple[int, int]:
        """Touched voxels and surfels; waits for the GPU (tests and reports only)."""
        slots, surfels = np.frombuffer(self.counters.read(8), np.uint32)
        return int(slots), int(surfels)

    def release(self) -> None:
        """Free all buffers."""
        for buffer in (self.grid, self.counters, self.surfels, self.touched, self.sums, self.delta_sums):
            buffer.release()


def bind_storage(buffers: dict[int, moderngl.Buffer]) -> None:
    """Bind buffers to storage bindings."""
    for binding, buffer in buffers.items():
        buffer.bind_to_storage_buffer(binding)
