"""Albedo of the real scene as the lights see it ([P2] eq. 1)."""

from pathlib import Path
from typing import Any

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, texture_2d
from render_server.passes.light_table import LightTable


class RealAlbedoPass:
    """RGBA16F atlas beside the real depth maps; filled are the texels of which a part may lie inside the volume."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self.atlas = texture_2d(gpu, (1, 1), 4, "f2")
        self._program = ComputeProgram(gpu, Path(__file__).with_name("real_albedo.comp.glsl"))

    def run(self, table: LightTable, uniforms: dict[str, Any]) -> None:
        """Fill the atlas; lights and picture must be bound."""
        if self.atlas.size != table.real_atlas.size:
            self.atlas.release()
            self.atlas = texture_2d(self._gpu, table.real_atlas.size, 4, "f2")
        bind_images(self.atlas)
        table.real_atlas.normal.use(location=13)
        threads = (table.tile_size, table.tile_size)
        for view in range(len(table.real_views)):
            self._program.run(threads, view_index=view, **uniforms)

    def release(self) -> None:
        """Free the GL objects."""
        self.atlas.release()
        self._program.release()
