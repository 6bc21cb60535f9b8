"""Injected light -> state of a light volume before the first step."""

from pathlib import Path

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.passes.light_volume import LightVolume
from render_server.passes.voxel_store import bind_storage


class LpvStartPass:
    """Turns fixed-point sums into intensities; the total begins with them."""

    def __init__(self, gpu: GpuContext) -> None:
        self._program = ComputeProgram(gpu, Path(__file__).with_name("lpv_start.comp.glsl"))

    def run(self, volume: LightVolume, sums: moderngl.Buffer, added: moderngl.Buffer | None = None) -> None:
        """Begin with `sums`, and those of `added` if given."""
        bind_storage({8: sums, 9: sums if added is None else added, 10: volume.state, 11: volume.total})
        self._program.run((volume.cells**3,), cells=volume.cells, has_second=added is not None)

    def release(self) -> None:
        """Free the program."""
        self._program.release()
