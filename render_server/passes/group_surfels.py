"""Groups of surfels for which light is gathered together, and each surfel's own light (METHOD 4.3)."""

from pathlib import Path
from typing import Any

import moderngl
import numpy as np

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.passes.voxel_store import VoxelStore, bind_storage

SHADER = Path(__file__).with_name("group_surfels.comp.glsl")
SURFEL_LIGHT_BYTES = 2 * 48  # front and back
GROUP_SUMS_BYTES = 32
GROUP_LIGHT_BYTES = 32
HEADER_BYTES = 8


class SurfelGroups:
    """Buffers beside one voxel store (passes/common/surfel_groups.glsl, surfel_light.glsl).

    There is room for a group a surfel; blocks of 2^3 voxels mostly hold many surfels of one main axis.
    """

    def __init__(self, gpu: GpuContext, volume_size: int) -> None:
        self._ctx = gpu.ctx
        self._grid = gpu.ctx.buffer(reserve=6 * (volume_size // 2) ** 3 * 4)
        self._room = 0
        self.lights = self._entries = self._sums = self._light = gpu.ctx.buffer(reserve=HEADER_BYTES)

    def start(self, store: VoxelStore) -> None:
        """Forget all groups and make room for those of `store`."""
        if store.surfel_capacity != self._room:
            self._grow(store.surfel_capacity)
        self._grid.clear()
        self._entries.write(bytes(HEADER_BYTES))

    def _grow(self, surfels: int) -> None:
        for buffer in {self.lights, self._entries, self._sums, self._light}:
            buffer.release()
        self._room = surfels
        self.lights = self._ctx.buffer(reserve=surfels * SURFEL_LIGHT_BYTES)
        self._entries = self._ctx.buffer(reserve=HEADER_BYTES + surfels * 4)
        self._sums = self._ctx.buffer(reserve=surfels * GROUP_SUMS_BYTES)
        self._light = self._ctx.buffer(reserve=surfels * GROUP_LIGHT_BYTES)

    def bind(self) -> None:
        """Bind to the places that the shaders name."""
        bind_storage({10: self._grid, 11: self.lights, 12: self._entries, 13: self._sums, 7: self._light})

    def counts(self) -> tuple[int, int]:
        """Groups, and those among them with surfels that the camera does not see; waits for the GPU."""
        groups, unseen = np.frombuffer(self._entries.read(HEADER_BYTES), np.uint32)
        return int(groups), int(unseen)

    def release(self) -> None:
        """Free all buffers."""
        buffers: set[moderngl.Buffer] = {self._grid, self.lights, self._entries, self._sums, self._light}
        for buffer in buffers:
            buffer.release()


class GroupSurfelsPass:
    """Two walks over the surfels: find the groups, then add up each one's area, normal and place."""

    def __init__(self, gpu: GpuContext) -> None:
        self._threads = list_threads(gpu)
        self._find = ComputeProgram(gpu, SHADER)
        self._sum = ComputeProgram(gpu, SHADER, {"SUM": 1})

    def run(
        self, store: VoxelStore, groups: SurfelGroups, uniforms: dict[str, Any], *, has_seen: bool
    ) -> None:
        """Fill `groups` (started before); `has_seen`: its surfel lights tell what the camera sees."""
        store.bind()
        groups.bind()
        self._find.run((self._threads,), **uniforms)
        self._sum.run((self._threads,), has_seen=has_seen, **uniforms)

    def release(self) -> None:
        """Free the programs."""
        self._find.release()
        self._sum.release()
