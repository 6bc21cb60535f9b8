"""Irradiance of light volumes on the reduced grid of the picture (METHOD 5)."""

from pathlib import Path
from typing import Any

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers
from render_server.passes.light_volume import LightVolume
from render_server.passes.sampling_grid import SamplingGrid
from render_server.passes.trace_cones import ConeFields
from render_server.passes.voxel_store import bind_storage

SHADER = Path(__file__).with_name("lpv_query.comp.glsl")


def bind_light_volumes(mu: LightVolume, rho: LightVolume) -> None:
    """Bind the light without and with objects to the places that lpv_light.glsl names."""
    bind_storage({8: mu.total, 9: rho.total})


class LpvQueryPass:
    """Fills the fields that cones fill elsewhere; lights, geometry and materials must be bound."""

    def __init__(self, gpu: GpuContext) -> None:
        self._real = ComputeProgram(gpu, SHADER, {"REAL": 1})
        self._change = ComputeProgram(gpu, SHADER, {"REAL": 1, "CHANGE": 1})
        self._virtual = ComputeProgram(gpu, SHADER)

    def read_real(
        self,
        fields: ConeFields,
        grid: SamplingGrid,
        mu: LightVolume | None,
        rho: LightVolume,
        uniforms: dict[str, Any],
    ) -> None:
        """E_mu and E_rho of real surfaces; without `mu`, `rho` is the change itself."""
        bind_samplers({0: grid.pixels})
        bind_images(fields.mu, fields.rho, fields.specular_mu, fields.specular_rho)
        bind_light_volumes(rho if mu is None else mu, rho)
        program = self._change if mu is None else self._real
        program.run(grid.size, low_resolution_size=grid.size, **uniforms)

    def read_virtual(
        self, fields: ConeFields, grid: SamplingGrid, rho: LightVolume, uniforms: dict[str, Any]
    ) -> None:
        """Irradiance of the virtual surfaces, and what a mirror there would show."""
        bind_samplers({0: grid.pixels})
        bind_images(fields.virtual)
        bind_images(fields.virtual_specular, first=3)
        bind_light_volumes(rho, rho)
        self._virtual.run(grid.size, low_resolution_size=grid.size, **uniforms)

    def release(self) -> None:
        """Free the programs."""
        for program in (self._real, self._change, self._virtual):
            program.release()
