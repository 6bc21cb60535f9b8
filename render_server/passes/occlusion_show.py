"""Occlusion fields -> cells for view `volume`."""

from pathlib import Path
from typing import Any

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images
from render_server.passes.object_field import FieldTextures
from render_server.passes.volume import Pyramid


class OcclusionShowPass:
    """Writes level 0 of a pyramid of one direction."""

    def __init__(self, gpu: GpuContext) -> None:
        self._program = ComputeProgram(gpu, Path(__file__).with_name("occlusion_show.comp.glsl"))

    def run(
        self, shown: Pyramid, field: FieldTextures | None, uniforms: dict[str, Any], *, first: bool
    ) -> None:
        """Add one object; the `first` one begins anew, and without a field shows nothing."""
        bind_images(shown.texture)
        slabs = 1
        if field is not None:
            field.occlusion.use(location=1)
            slabs = -(-field.field.occlusion.shape[-1] // 4)
        own: dict[str, Any] = {"slabs": slabs, "first": first, "has_field": field is not None}
        size = int(uniforms["volume_size"])
        self._program.run((size, size, size), **own, **uniforms)

    def release(self) -> None:
        """Free the program."""
        self._program.release()
