"""Direct light on the real surfaces, without and with the objects."""

from pathlib import Path
from typing import Any

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, texture_2d


class DirectLightPass:
    """E_mu and E_rho of the lights (RGBA16F), and their lobes on declared specular surfaces.

    With `shadow_cones` the objects' shadows come from cones through the voxels ([P1] eq. 4) of a pyramid of
    so many directions, bound to unit 3; without, from the shadow maps; without `objects_shadow`, from elsewhere, and
    E_rho is E_mu.
    """

    def __init__(
        self,
        gpu: GpuContext,
        size: tuple[int, int],
        *,
        shadow_cones: int | None = None,
        objects_shadow: bool = True,
    ) -> None:
        self._size = size
        self.mu = texture_2d(gpu, size, 4, "f2")
        self.rho = texture_2d(gpu, size, 4, "f2")
        self.lobe_mu = texture_2d(gpu, size, 4, "f2")
        self.lobe_rho = texture_2d(gpu, size, 4, "f2")
        defines = {} if shadow_cones is None else {"SHADOW_CONES": 1, "DIRECTIONS": shadow_cones}
        if not objects_shadow:
            defines = {"REAL_SHADOWS": 1}
        self._program = ComputeProgram(gpu, Path(__file__).with_name("direct_light.comp.glsl"), defines)

    def run(self, uniforms: dict[str, Any]) -> None:
        """Shade every pixel; lights, geometry and surfaces must be bound."""
        bind_images(self.mu, self.rho, self.lobe_mu, self.lobe_rho)
        self._program.run(self._size, **uniforms)

    def release(self) -> None:
        """Free the GL objects."""
        for item in (self.mu, self.rho, self.lobe_mu, self.lobe_rho, self._program):
            item.release()
