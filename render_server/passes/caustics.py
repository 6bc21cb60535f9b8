"""Light that smooth virtual surfaces throw on others: beams from the lights' maps of the objects, added to pixels."""

import math
from pathlib import Path
from typing import Any

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.gpu.textures import bind_samplers
from render_server.passes.light_table import LightTable
from render_server.passes.object_tree import ObjectTree
from render_server.passes.sampling_grid import SamplingGrid

FOLDER = Path(__file__).parent
# A light's map of the objects is cut into so many blocks an edge, each sends so many rays: they start a 128th of the
# objects' extent apart, and after a convex object has spread them four- to eightfold they are as far apart as voxels.
BLOCKS = 64
RAYS = 4
# From this GGX alpha on a lobe (2 alpha wide) is wider, at half the objects' extent, than such beams are: then rays
# sample the lobe, of which each holds a part.
WIDE_ALPHA = 1 / 32
# A lobe that holds 85 % of its energy within 45 degrees and more is as good as diffuse: voxels carry that.
GREATEST_ALPHA = 0.174
BEAM_BYTES = 64
HEADER_BYTES = 16
PLACE_BYTES = 6 * 4
GROUP = 64  # invocations of a workgroup, one a beam


class CausticsPass:
    """`sums`: fixed-point irradiance on real surfaces and objects, a pixel each (passes/common/caustic_sums.glsl)."""

    def __init__(self, gpu: GpuContext, grid: SamplingGrid, objects: ObjectTree) -> None:
        self._threads, self._grid, self._objects = list_threads(gpu), grid, objects
        self.sums = gpu.ctx.buffer(
            reserve=PLACE_BYTES * (math.prod(grid.picture_size) + math.prod(grid.size))
        )
        self._beams = gpu.ctx.buffer(reserve=HEADER_BYTES + BEAM_BYTES)
        path = FOLDER / "caustic_beams.comp.glsl"
        self._sharp, self._wide = (
            ComputeProgram(gpu, path, {"RAY_COUNT": RAYS, "RAY_ROUGHNESS": 1.0, **kind})
            for kind in ({}, {"WIDE": 1})
        )
        self._splat = ComputeProgram(gpu, FOLDER / "caustic_splat.comp.glsl")

    def run(self, table: LightTable, uniforms: dict[str, Any]) -> None:
        """Fill `sums`; lights, geometry and materials must be bound.

        Uniforms beside those of the view: `bias_real`, `normal_offset`, `reach` (m).
        """
        self.sums.clear()
        self._start_beams(len(table.virtual_views))
        self._objects.bind()
        bind_samplers({16: table.virtual_atlas.uv, 17: table.virtual_atlas.normal})
        for view in range(len(table.virtual_views)):
            index = table.first_virtual_view + view
            own = {"view_index": index, "block_edge": max(table.tile_size // BLOCKS, 1), **uniforms}
            self._sharp.run((BLOCKS, BLOCKS, RAYS), least_alpha=0.0, greatest_alpha=WIDE_ALPHA, **own)
            self._wide.run(
                (BLOCKS, BLOCKS, RAYS), least_alpha=WIDE_ALPHA, greatest_alpha=GREATEST_ALPHA, **own
            )
        self.bind()
        bind_samplers({0: self._grid.pixels})
        self._splat.run(
            (self._threads,), picture_pixels=self._grid.picture_size, scale=self._grid.scale, **uniforms
        )

    def _start_beams(self, views: int) -> None:
        most = views * BLOCKS**2 * RAYS
        needed = HEADER_BYTES + BEAM_BYTES * max(most, 1)
        if self._beams.size < needed:
            self._beams.orphan(needed)
        self._beams.write(bytes(HEADER_BYTES))
        self._beams.bind_to_storage_buffer(7)

    def bind(self) -> None:
        """Bind the sums to the place that caustic_sums.glsl names."""
        self.sums.bind_to_storage_buffer(8)

    def release(self) -> None:
        """Free the GL objects."""
        for item in vars(self).values():
            if hasattr(item, "release") and item not in (self._grid, self._objects):
                item.release()
