"""Cone tracing of the paper's operator ([P1] eq. 6 and 8)."""

from pathlib import Path
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers
from render_server.passes.sampling_grid import SamplingGrid
from render_server.passes.trace_cones import ConeFields
from render_server.passes.volume import Pyramid

SHADER = Path(__file__).with_name("trace_paper.comp.glsl")


class TracePaperPass:
    """Nine diffuse cones and a specular one: V_delta on real surfaces, V_rho on virtual ones."""

    def __init__(self, gpu: GpuContext) -> None:
        self._real = ComputeProgram(gpu, SHADER, {"DIRECTIONS": 1, "REAL": 1})
        self._virtual = ComputeProgram(gpu, SHADER, {"DIRECTIONS": 1})

    def trace_real(
        self,
        fields: ConeFields,
        grid: SamplingGrid,
        delta: Pyramid,
        linear_picture: moderngl.Texture,
        uniforms: dict[str, Any],
    ) -> None:
        """Ambient irradiance without occlusion (mu), the same with C_delta (rho), and the specular cones."""
        bind_samplers({0: grid.pixels, 3: delta.texture, 8: linear_picture})
        bind_images(fields.mu, fields.rho, fields.specular_mu, fields.specular_rho)
        self._real.run(grid.size, low_resolution_size=grid.size, **uniforms)

    def trace_virtual(
        self, fields: ConeFields, grid: SamplingGrid, rho: Pyramid, uniforms: dict[str, Any]
    ) -> None:
        """Irradiance and specular cone of the virtual surfaces."""
        bind_samplers({0: grid.pixels, 3: rho.texture})
        bind_images(fields.virtual)
        bind_images(fields.virtual_specular, first=3)
        self._virtual.run(grid.size, low_resolution_size=grid.size, **uniforms)

    def release(self) -> None:
        """Free the programs."""
        self._real.release()
        self._virtual.release()
