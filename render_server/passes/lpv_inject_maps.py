"""Injection of reflective shadow maps into light propagation volumes ([P2] 4.3)."""

from pathlib import Path
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_samplers
from render_server.passes.caustics import GREATEST_ALPHA
from render_server.passes.light_table import LightTable

SHADER = Path(__file__).with_name("lpv_inject_maps.comp.glsl")


class LpvInjectMapsPass:
    """Adds to fixed-point sums; lights and the objects' materials must be bound."""

    def __init__(self, gpu: GpuContext) -> None:
        limit = {"GREATEST_ALPHA": GREATEST_ALPHA}
        self._real = ComputeProgram(gpu, SHADER, {"REAL": 1, **limit})
        self._change = ComputeProgram(gpu, SHADER, limit)
        self._direct = ComputeProgram(gpu, SHADER, {"DIRECT": 1, **limit})

    def add_real(
        self,
        sums: moderngl.Buffer,
        table: LightTable,
        real_albedo: moderngl.Texture,
        uniforms: dict[str, Any],
    ) -> None:
        """What the real scene reflects where no object stands in the way."""
        _bind(sums, table, real_albedo)
        for view in range(len(table.real_views)):
            self._real.run(_threads(table), view_index=view, **uniforms)

    def add_change(
        self,
        sums: moderngl.Buffer,
        table: LightTable,
        real_albedo: moderngl.Texture,
        uniforms: dict[str, Any],
    ) -> None:
        """What the objects reflect, less what the real scene behind them reflected."""
        self._add_virtual(self._change, sums, table, real_albedo, uniforms)

    def add_shadow(
        self,
        sums: moderngl.Buffer,
        table: LightTable,
        real_albedo: moderngl.Texture,
        uniforms: dict[str, Any],
    ) -> None:
        """The lights themselves, negative, where the objects keep them off."""
        self._add_virtual(self._direct, sums, table, real_albedo, uniforms)

    def _add_virtual(
        self,
        program: ComputeProgram,
        sums: moderngl.Buffer,
        table: LightTable,
        real_albedo: moderngl.Texture,
        uniforms: dict[str, Any],
    ) -> None:
        _bind(sums, table, real_albedo)
        for view in range(len(table.virtual_views)):
            program.run(_threads(table), view_index=table.first_virtual_view + view, **uniforms)

    def release(self) -> None:
        """Free the programs."""
        for program in (self._real, self._change, self._direct):
            program.release()


def _bind(sums: moderngl.Buffer, table: LightTable, real_albedo: moderngl.Texture) -> None:
    sums.bind_to_storage_buffer(10)
    atlas = table.virtual_atlas
    bind_samplers({8: real_albedo, 13: table.real_atlas.normal, 16: atlas.uv, 17: atlas.normal})


def _threads(table: LightTable) -> tuple[int, int]:
    return table.tile_size, table.tile_size
