"""Injected change -> cells for view `volume`."""

from pathlib import Path

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images
from render_server.passes.volume import Pyramid
from render_server.passes.voxel_store import bind_storage


class LpvShowPass:
    """Writes level 0 of a pyramid of one direction."""

    def __init__(self, gpu: GpuContext) -> None:
        self._program = ComputeProgram(gpu, Path(__file__).with_name("lpv_show.comp.glsl"))

    def run(self, shown: Pyramid, cells: int, change: moderngl.Buffer, shadow: moderngl.Buffer) -> None:
        """Show the sums of both buffers."""
        bind_images(shown.texture)
        bind_storage({8: change, 9: shadow})
        self._program.run((cells, cells, cells), cells=cells)

    def release(self) -> None:
        """Free the program."""
        self._program.release()
