"""Radiance around one object, and its products with transfer and harmonics for every normal."""

from pathlib import Path
from typing import Any

import moderngl
import numpy as np

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d
from render_server.lights.octahedral import MAX_ORDER, harmonics, octahedral_grid, texel_solid_angles
from render_server.passes.object_field import field_texture
from render_server.passes.picture import Picture
from render_server.passes.sampling_grid import SamplingGrid
from render_server.passes.voxel_store import bind_storage

FOLDER = Path(__file__).parent
PROBE_SIZE = 32
TEXELS = PROBE_SIZE**2


class LightProbe:
    """`radiance` (RGBA16F, octahedral, asset's axes; a: share that the camera sees) and `products` of an object."""

    def __init__(self, gpu: GpuContext, length: int) -> None:
        size = (PROBE_SIZE, PROBE_SIZE)
        self.radiance = texture_2d(gpu, size, 4, "f2", linear=True)
        self.products = field_texture(gpu, (*size, length + 1))

    def release(self) -> None:
        """Free the textures."""
        self.radiance.release()
        self.products.release()


class LightProbePass:
    """Fills probes one after the other; `length` harmonics an occlusion field."""

    def __init__(self, gpu: GpuContext, length: int) -> None:
        self._length = length
        directions = octahedral_grid(PROBE_SIZE).reshape(-1, 3)
        table = np.column_stack(
            [texel_solid_angles(PROBE_SIZE).ravel(), harmonics(directions, MAX_ORDER)]
        ).astype(np.float32)
        self._table = gpu.ctx.buffer(np.ascontiguousarray(table).tobytes())
        self._sums = gpu.ctx.buffer(reserve=TEXELS * 16)
        self._pairs = gpu.ctx.buffer(reserve=MAX_ORDER**2 * length * 16)
        self._gather = ComputeProgram(gpu, FOLDER / "probe_gather.comp.glsl")
        self._gather_changed = ComputeProgram(gpu, FOLDER / "probe_gather.comp.glsl", {"CHANGED": 1})
        self._resolve = ComputeProgram(gpu, FOLDER / "probe_resolve.comp.glsl")
        defines = {"SH_LENGTH": length}
        self._pair = ComputeProgram(gpu, FOLDER / "light_products.comp.glsl", {**defines, "PAIRS": 1})
        self._tabulate = ComputeProgram(gpu, FOLDER / "light_products.comp.glsl", defines)

    def gather(
        self,
        picture: Picture,
        grid: SamplingGrid,
        uniforms: dict[str, Any],
        changes: moderngl.Texture | None = None,
    ) -> None:
        """Sum what the camera sees around the object; geometry must be bound.

        `changes`: by what factor objects change the light at each texel of the grid; the sum is then of that.
        """
        self._sums.clear()
        bind_storage({8: self._sums, 9: self._table})
        bind_samplers({0: grid.pixels, 8: picture.linear})
        program = self._gather
        if changes is not None:
            changes.use(location=1)
            program = self._gather_changed
        program.run(grid.size, scale=grid.scale, **uniforms)

    def forget(self) -> None:
        """Nothing is seen; the environment alone shines."""
        self._sums.clear()

    def resolve(self, probe: LightProbe, uniforms: dict[str, Any]) -> None:
        """Radiance from what was gathered and the environment, which must be bound, and its products."""
        bind_storage({8: self._sums, 9: self._table})
        bind_images(probe.radiance)
        self._resolve.run((TEXELS,), **uniforms)
        self.multiply(probe)

    def multiply(self, probe: LightProbe) -> None:
        """The products of a probe's radiance."""
        bind_storage({8: self._pairs, 9: self._table})
        bind_samplers({1: probe.radiance})
        self._pair.run((MAX_ORDER**2 * self._length,))
        bind_images(probe.products)
        self._tabulate.run((TEXELS, self._length + 1))

    def bind_table(self) -> None:
        """Bind the directions (passes/common/light_probe.glsl)."""
        bind_storage({9: self._table})

    def release(self) -> None:
        """Free the GL objects."""
        for item in vars(self).values():
            if hasattr(item, "release"):
                item.release()
