"""Injection of what surfaces do to the light of the surroundings, and of what they emit."""

from pathlib import Path
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.passes.voxel_store import VoxelStore

SHADER = Path(__file__).with_name("lpv_inject_surfaces.comp.glsl")


class LpvInjectSurfacesPass:
    """Adds to fixed-point sums; lights, picture and materials must be bound."""

    def __init__(self, gpu: GpuContext) -> None:
        self._threads = list_threads(gpu)
        self._real = ComputeProgram(gpu, SHADER, {"REAL": 1})
        self._virtual = ComputeProgram(gpu, SHADER)

    def add_real(self, sums: moderngl.Buffer, store: VoxelStore, uniforms: dict[str, Any]) -> None:
        """The real scene's surfels."""
        self._add(self._real, sums, store, uniforms)

    def add_virtual(self, sums: moderngl.Buffer, store: VoxelStore, uniforms: dict[str, Any]) -> None:
        """The objects' surfels."""
        self._add(self._virtual, sums, store, uniforms)

    def _add(
        self, program: ComputeProgram, sums: moderngl.Buffer, store: VoxelStore, uniforms: dict[str, Any]
    ) -> None:
        store.bind()
        sums.bind_to_storage_buffer(10)
        program.run((self._threads,), **uniforms)

    def release(self) -> None:
        """Free the programs."""
        self._real.release()
        self._virtual.release()
