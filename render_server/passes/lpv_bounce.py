"""Injection of what surfaces reflect of the light that propagation brought to them."""

from pathlib import Path
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.passes.light_volume import LightVolume
from render_server.passes.lpv_query import bind_light_volumes
from render_server.passes.voxel_store import VoxelStore

SHADER = Path(__file__).with_name("lpv_bounce.comp.glsl")


class LpvBouncePass:
    """Adds to fixed-point sums; lights, picture and materials must be bound."""

    def __init__(self, gpu: GpuContext) -> None:
        self._threads = list_threads(gpu)
        self._real = ComputeProgram(gpu, SHADER, {"REAL": 1})
        self._virtual = ComputeProgram(gpu, SHADER)

    def run(
        self,
        sums: moderngl.Buffer,
        stores: tuple[VoxelStore, VoxelStore],
        light: tuple[LightVolume, LightVolume],
        uniforms: dict[str, Any],
    ) -> None:
        """Real and virtual surfels under the light without and with objects."""
        bind_light_volumes(*light)
        sums.bind_to_storage_buffer(10)
        for program, store in zip((self._real, self._virtual), stores, strict=True):
            store.bind()
            program.run((self._threads,), **uniforms)

    def release(self) -> None:
        """Free the programs."""
        self._real.release()
        self._virtual.release()
