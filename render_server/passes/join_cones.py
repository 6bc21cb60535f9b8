"""Irradiance of neighbouring texels joined, each of which looked along other cones."""

from pathlib import Path
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers
from render_server.passes.sampling_grid import SamplingGrid

SHADER = Path(__file__).with_name("join_cones.comp.glsl")


class JoinConesPass:
    """Joint bilateral tent over 3 x 3 texels; geometry must be bound."""

    def __init__(self, gpu: GpuContext) -> None:
        self._real = ComputeProgram(gpu, SHADER, {"REAL": 1})
        self._virtual = ComputeProgram(gpu, SHADER)

    def join_real(
        self,
        traced: tuple[moderngl.Texture, moderngl.Texture],
        joined: tuple[moderngl.Texture, moderngl.Texture],
        grid: SamplingGrid,
        uniforms: dict[str, Any],
    ) -> None:
        """E_mu and E_rho of the real surfaces; where mu and rho are the same they stay the same, bit for bit."""
        bind_images(*joined)
        bind_samplers({0: grid.pixels, 8: traced[1], 9: traced[0]})
        self._real.run(grid.size, low_resolution_size=grid.size, **uniforms)

    def join_virtual(
        self,
        traced: moderngl.Texture,
        joined: moderngl.Texture,
        grid: SamplingGrid,
        uniforms: dict[str, Any],
    ) -> None:
        """E_rho of the virtual surfaces."""
        bind_images(joined, first=1)
        bind_samplers({0: grid.pixels, 8: traced})
        self._virtual.run(grid.size, low_resolution_size=grid.size, **uniforms)

    def release(self) -> None:
        """Free the programs."""
        self._real.release()
        self._virtual.release()
