"""Isotropic filtering ([P1] 3.2): the levels of V_delta and V_rho above level 0."""

from pathlib import Path

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images
from render_server.passes.volume import Pyramid, VolumePlacement


class FilterIsotropicPass:
    """One dispatch a level, both volumes at once."""

    def __init__(self, gpu: GpuContext) -> None:
        path = Path(__file__).with_name("filter_isotropic.comp.glsl")
        self._program = ComputeProgram(gpu, path, {"DIRECTIONS": 1})

    def run(self, delta: Pyramid, rho: Pyramid, placement: VolumePlacement) -> None:
        """Rebuild all levels from level 0."""
        bind_images(delta.texture, rho.texture)
        for level in range(1, placement.levels):
            cells = placement.size >> level
            self._program.run((cells,) * 3, level=level, **placement.uniforms())

    def release(self) -> None:
        """Free the program."""
        self._program.release()
