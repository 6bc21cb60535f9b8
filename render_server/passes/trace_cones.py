"""Cone tracing of the exact operator (METHOD 3, 4.5)."""

from pathlib import Path
from typing import Any

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d
from render_server.passes.join_cones import JoinConesPass
from render_server.passes.sampling_grid import SamplingGrid
from render_server.passes.volume import Pyramid

SHADER = Path(__file__).with_name("trace_cones.comp.glsl")
SELECT = Path(__file__).with_name("select_texels.comp.glsl")


class ConeFields:
    """What cones bring, at 1/scale of the picture: irradiance (diffuse) and mean radiance (specular cone)."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.mu = texture_2d(gpu, size, 4, "f2")
        self.rho = texture_2d(gpu, size, 4, "f2")
        self.specular_mu = texture_2d(gpu, size, 4, "f2")
        self.specular_rho = texture_2d(gpu, size, 4, "f2")
        self.virtual = texture_2d(gpu, size, 4, "f2")
        self.virtual_specular = texture_2d(gpu, size, 4, "f2")

    def release(self) -> None:
        """Free the textures."""
        for texture in vars(self).values():
            texture.release()


def bind_pyramids(mu: Pyramid, rho: Pyramid) -> None:
    """Bind the voxels without and with objects to the places that march.glsl names."""
    bind_samplers({2: mu.texture, 3: rho.texture})


class TraceConesPass:
    """Dual march on real surfaces, rho march on virtual ones; lights, geometry and support must be bound.

    `size` is that of the reduced grid, `defines` are those of march.glsl.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int], defines: dict[str, int]) -> None:
        self._gpu = gpu
        self._mu, self._rho, self._irradiance = (texture_2d(gpu, size, 4, "f2") for _ in range(3))
        self._join = JoinConesPass(gpu)
        self._real = ComputeProgram(gpu, SHADER, {"REAL": 1, **defines})
        self._virtual = ComputeProgram(gpu, SHADER, defines)
        self._select = ComputeProgram(gpu, SELECT, {"REAL": 1})
        self._texels = gpu.ctx.buffer(reserve=4)

    def trace_real(
        self, fields: ConeFields, grid: SamplingGrid, mu: Pyramid, rho: Pyramid, uniforms: dict[str, Any]
    ) -> None:
        """E_mu, E_rho and the specular cones of the real surfaces."""
        traced = (self._mu, self._rho)
        bind_images(*traced, fields.specular_mu, fields.specular_rho)
        needed = 4 * (1 + grid.size[0] * grid.size[1])
        if self._texels.size < needed:
            self._texels.orphan(needed)
        self._texels.write(bytes(4))
        self._texels.bind_to_storage_buffer(6)
        bind_samplers({0: grid.pixels, 2: mu.texture, 3: rho.texture})
        self._select.run(grid.size, low_resolution_size=grid.size, **uniforms)
        self._real.run(self._threads(grid), low_resolution_size=grid.size, **uniforms)
        self._join.join_real(traced, (fields.mu, fields.rho), grid, uniforms)

    def trace_virtual(
        self, fields: ConeFields, grid: SamplingGrid, mu: Pyramid, rho: Pyramid, uniforms: dict[str, Any]
    ) -> None:
        """E_rho and the specular cone of the virtual surfaces."""
        self._irradiance.write(bytes(8 * grid.size[0] * grid.size[1]))
        bind_images(self._irradiance)
        fields.virtual_specular.bind_to_image(3, read=True, write=True)
        grid.virtual_texels.bind_to_storage_buffer(6)
        bind_samplers({0: grid.pixels, 2: mu.texture, 3: rho.texture})
        self._virtual.run(self._threads(grid), low_resolution_size=grid.size, **uniforms)
        self._join.join_virtual(self._irradiance, fields.virtual, grid, uniforms)

    def _threads(self, grid: SamplingGrid) -> tuple[int]:
        return (list_threads(self._gpu, grid.size[0] * grid.size[1]),)

    def release(self) -> None:
        """Free the GL objects."""
        for item in vars(self).values():
            if hasattr(item, "release") and item is not self._gpu:
                item.release()
