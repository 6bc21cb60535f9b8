"""Light that objects reflect onto what is around them, from their transfer fields."""

from pathlib import Path
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d
from render_server.passes.light_probe import LightProbe
from render_server.passes.object_field import FieldTextures
from render_server.passes.sampling_grid import SamplingGrid
from render_server.passes.voxel_store import bind_storage
from render_server.scene.occlusion_transfer import LENGTH

FOLDER = Path(__file__).parent


class ObjectGlowPass:
    """`gained` (irradiance) and `mirrored` (radiance of objects), RGBA32F on the reduced grid."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.gained, self.mirrored = (texture_2d(gpu, size, 4, "f4") for _ in range(2))
        self._incident = gpu.ctx.buffer(reserve=LENGTH * 16)
        self._light = ComputeProgram(gpu, FOLDER / "object_glow.comp.glsl", {"LIGHT": 1})
        self._collapse = ComputeProgram(gpu, FOLDER / "object_glow.comp.glsl")
        self._real = ComputeProgram(gpu, FOLDER / "glow_shade.comp.glsl", {"REAL": 1})
        self._virtual = ComputeProgram(gpu, FOLDER / "glow_shade.comp.glsl")

    def light(
        self, field: FieldTextures, probe: LightProbe, glow: moderngl.Texture3D, uniforms: dict[str, Any]
    ) -> None:
        """What the object sends back of its light into `glow`; lights and the probe's table must be bound."""
        assert field.transfer is not None
        bind_samplers({1: probe.radiance})
        bind_storage({7: field.transfer, 8: self._incident})
        self._light.run((LENGTH,), **uniforms)
        bind_images(glow)
        self._collapse.run((len(field.field.occlusion) * field.glow_size**3, LENGTH), **uniforms)

    def shade(
        self,
        grid: SamplingGrid,
        glow: moderngl.Texture3D,
        uniforms: dict[str, Any],
        *,
        first: bool,
        real: bool,
    ) -> None:
        """Add one object's light; the `first` one begins anew."""
        bind_samplers({0: grid.pixels, 1: glow})
        bind_images(self.gained, self.mirrored)
        program = self._real if real else self._virtual
        program.run(grid.size, low_resolution_size=grid.size, first=first, **uniforms)

    def release(self) -> None:
        """Free the GL objects."""
        for item in vars(self).values():
            item.release()
