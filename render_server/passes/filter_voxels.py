"""Filtering: the levels of a pyramid above level 0 (METHOD 4.4)."""

from pathlib import Path

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images
from render_server.passes.volume import Pyramid, VolumePlacement

DIRECTIONS = 6


class FilterVoxelsPass:
    """One dispatch a level, all six directions."""

    def __init__(self, gpu: GpuContext) -> None:
        self._program = ComputeProgram(gpu, Path(__file__).with_name("filter_voxels.comp.glsl"))

    def run(self, pyramid: Pyramid, placement: VolumePlacement) -> None:
        """Rebuild all levels from level 0."""
        bind_images(pyramid.texture)
        for level in range(1, placement.levels):
            cells = placement.size >> level
            self._program.run((cells, cells, cells * DIRECTIONS), level=level, **placement.uniforms())

    def release(self) -> None:
        """Free the program."""
        self._program.release()
