"""By what factor the objects change the light of the real surfaces, on the reduced grid."""

from pathlib import Path
from typing import Any

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d
from render_server.passes.occlusion_shade import OcclusionShadePass
from render_server.passes.sampling_grid import SamplingGrid


class LightChangePass:
    """`changes` (RGBA16F): E_rho / E_mu of lamps and natural light."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.changes = texture_2d(gpu, size, 4, "f2")
        self._program = ComputeProgram(gpu, Path(__file__).with_name("light_change.comp.glsl"), {"REAL": 1})

    def run(self, grid: SamplingGrid, shade: OcclusionShadePass, uniforms: dict[str, Any]) -> None:
        """Compare what `shade` found; lights and geometry must be bound."""
        kept, natural, _ = shade.textures()
        bind_samplers({0: grid.pixels, 1: kept, 2: natural})
        bind_images(self.changes)
        self._program.run(grid.size, low_resolution_size=grid.size, **uniforms)

    def release(self) -> None:
        """Free the GL objects."""
        self.changes.release()
        self._program.release()
