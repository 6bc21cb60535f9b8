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

    def run(self, volume: LightVolume, *sums: moderngl.Buffer) -> None:
        """Begin with the total of one to three sums."""
        first, second, third = (*sums, sums[0], sums[0])[:3]
        bind_storage({8: first, 9: second, 10: volume.state, 11: volume.total, 12: third})
        self._program.run((volume.cells**3,), cells=volume.cells, count_of_sums=len(sums))

    def release(self) -> None:
        """Free the program."""
        self._program.release()
