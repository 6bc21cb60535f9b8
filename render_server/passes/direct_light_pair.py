"""Direct light on the real surfaces of two full solutions, each under its own shadow maps (METHOD 6)."""

from typing import Any

from render_server.gpu.context import GpuContext
from render_server.gpu.textures import bind_images, texture_2d
from render_server.passes.direct_light import DirectLightPass
from render_server.passes.light_table import LightTable


class DirectLightPairPass(DirectLightPass):
    """E_mu by the maps of one table, E_rho by those of another; neither has maps of objects alone."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        super().__init__(gpu, size, objects_shadow=False)
        self._unused = texture_2d(gpu, size, 4, "f2")

    def run_both(self, mu: LightTable, rho: LightTable, uniforms: dict[str, Any]) -> None:
        """Shade every pixel twice; geometry and surfaces must be bound. Leaves the lights of `rho` bound."""
        mu.bind()
        self.run(uniforms)
        rho.bind()
        bind_images(self._unused, self.rho, self._unused, self.lobe_rho)
        self._program.run(self._size, **uniforms)

    def release(self) -> None:
        """Free the GL objects."""
        self._unused.release()
        super().release()
