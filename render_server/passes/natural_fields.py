"""Natural light without and with the objects, in the place of what cones bring."""

from pathlib import Path
from typing import Any

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers
from render_server.passes.object_glow import ObjectGlowPass
from render_server.passes.occlusion_shade import OcclusionShadePass
from render_server.passes.sampling_grid import SamplingGrid
from render_server.passes.trace_cones import ConeFields

SHADER = Path(__file__).with_name("natural_fields.comp.glsl")


class NaturalFieldsPass:
    """Writes the fields; lights, geometry and materials must be bound."""

    def __init__(self, gpu: GpuContext) -> None:
        self._real = ComputeProgram(gpu, SHADER, {"REAL": 1})
        self._virtual = ComputeProgram(gpu, SHADER)

    def run(
        self,
        fields: ConeFields,
        grid: SamplingGrid,
        shade: OcclusionShadePass,
        glow: ObjectGlowPass | None,
        uniforms: dict[str, Any],
        *,
        real: bool,
    ) -> None:
        """Write those of real or of virtual surfaces; without `glow` objects reflect nothing."""
        kept, natural, mirrored = shade.textures()
        bind_samplers({0: grid.pixels, 1: kept, 2: natural, 8: mirrored})
        if glow is not None:
            bind_samplers({3: glow.gained, 9: glow.mirrored})
        own: dict[str, Any] = {"has_glow": glow is not None, "low_resolution_size": grid.size}
        if real:
            bind_images(fields.mu, fields.rho, fields.specular_mu, fields.specular_rho)
        else:
            bind_images(fields.virtual)
            bind_images(fields.virtual_specular, first=3)
        program = self._real if real else self._virtual
        program.run(grid.size, **own, **uniforms)

    def release(self) -> None:
        """Free the programs."""
        self._real.release()
        self._virtual.release()
