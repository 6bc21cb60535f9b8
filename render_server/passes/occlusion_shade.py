"""What objects leave of natural light, one object after the other."""

from pathlib import Path
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d
from render_server.passes.light_probe import LightProbe
from render_server.passes.object_field import FieldTextures
from render_server.passes.sampling_grid import SamplingGrid

SHADER = Path(__file__).with_name("occlusion_shade.comp.glsl")


class OcclusionShadePass:
    """`kept`, `natural` and `mirrored` (RGBA32F) on the reduced grid; lights, geometry, materials must be bound."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int], length: int) -> None:
        self.kept, self.natural, self.mirrored = (texture_2d(gpu, size, 4, "f4") for _ in range(3))
        self._real = ComputeProgram(gpu, SHADER, {"SH_LENGTH": length, "REAL": 1})
        self._virtual = ComputeProgram(gpu, SHADER, {"SH_LENGTH": length})

    def run(
        self,
        grid: SamplingGrid,
        probe: LightProbe,
        field: FieldTextures | None,
        uniforms: dict[str, Any],
        *,
        first: bool,
        real: bool,
    ) -> None:
        """Take into account one object; the `first` one begins anew. Without a field it hides nothing."""
        bind_samplers({0: grid.pixels, 2: probe.products, 3: probe.radiance})
        if field is not None:
            field.occlusion.use(location=1)
        bind_images(self.kept, self.natural, self.mirrored)
        own: dict[str, Any] = {"first": first, "has_field": field is not None}
        program = self._real if real else self._virtual
        program.run(grid.size, low_resolution_size=grid.size, **own, **uniforms)

    def textures(self) -> tuple[moderngl.Texture, moderngl.Texture, moderngl.Texture]:
        """What was filled: kept, natural, mirrored."""
        return self.kept, self.natural, self.mirrored

    def release(self) -> None:
        """Free the GL objects."""
        for item in (self.kept, self.natural, self.mirrored, self._real, self._virtual):
            item.release()
