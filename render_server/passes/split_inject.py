"""Split-inject: the flux of reflective shadow maps into the voxels of V_delta and V_rho ([P1] 3.2)."""

from pathlib import Path
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_samplers
from render_server.passes.light_table import LightTable
from render_server.passes.voxel_store import VoxelStore, bind_storage

SHADER = Path(__file__).with_name("split_inject.comp.glsl")
LIGHT_SUMS = 6  # a slot: V_delta and V_rho, three channels each


class SplitInjectPass:
    """Sums into `delta_sums` of both stores (fixed point, so that the order of threads does not matter)."""

    def __init__(self, gpu: GpuContext) -> None:
        self._real = ComputeProgram(gpu, SHADER)
        self._virtual = ComputeProgram(gpu, SHADER, {"VIRTUAL": 1})

    def run(
        self,
        real: VoxelStore,
        virtual: VoxelStore,
        table: LightTable,
        real_albedo: moderngl.Texture,
        uniforms: dict[str, Any],
    ) -> None:
        """Inject all lights; lights and the objects' materials must be bound."""
        for store in (real, virtual):
            store.delta_sums.clear(size=store.slot_capacity * LIGHT_SUMS * 4)
        real.bind()
        bind_storage({8: real.delta_sums, 9: virtual.grid, 10: virtual.delta_sums})
        atlas = table.virtual_atlas
        bind_samplers({8: real_albedo, 13: table.real_atlas.normal, 16: atlas.uv, 17: atlas.normal})
        threads = (table.tile_size, table.tile_size)
        for view in range(len(table.real_views)):
            self._real.run(threads, view_index=view, **uniforms)
        for view in range(len(table.virtual_views)):
            self._virtual.run(threads, view_index=table.first_virtual_view + view, **uniforms)

    def release(self) -> None:
        """Free the programs."""
        self._real.release()
        self._virtual.release()
