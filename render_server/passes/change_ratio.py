"""How light changed, on the reduced grid: for holes of the depth map, and to compose only what changed."""

from pathlib import Path

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d
from render_server.passes.direct_light import DirectLightPass
from render_server.passes.sampling_grid import SamplingGrid
from render_server.passes.trace_cones import ConeFields

SHADER = Path(__file__).with_name("change_ratio.comp.glsl")
FILL_RADIUS = 3  # texels of the reduced grid over which the change continues into a hole


class ChangeRatioPass:
    """`ratio` (rgb E_rho / E_mu, a: 0 unknown, 1 unchanged, 2 changed) and `texels`, those near a change."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.ratio = texture_2d(gpu, size, 4, "f2")
        self.texels = gpu.ctx.buffer(bytes(4 * (1 + size[0] * size[1])))
        self._ratio = ComputeProgram(gpu, SHADER, {"RATIO": 1})
        self._near = ComputeProgram(gpu, SHADER, {"FILL_RADIUS": FILL_RADIUS})

    def run(
        self,
        grid: SamplingGrid,
        direct: DirectLightPass,
        cones: ConeFields,
        reflection: moderngl.Texture | None,
    ) -> None:
        """Compare the fields of one frame; `reflection` as in RelitLayers."""
        bind_samplers(
            {0: grid.pixels, 1: direct.mu, 2: direct.rho, 3: cones.mu, 8: cones.rho, 9: self.ratio}
            | {16: cones.specular_mu, 17: cones.specular_rho}
        )
        if reflection is not None:
            reflection.use(location=18)
        bind_images(self.ratio)
        self._ratio.run(grid.size, scale=grid.scale, has_reflection=reflection is not None)
        self.texels.write(bytes(4))
        self.texels.bind_to_storage_buffer(6)
        self._near.run(grid.size)

    def release(self) -> None:
        """Free the GL objects."""
        for item in (self.ratio, self.texels, self._ratio, self._near):
            item.release()
