"""Where smooth real planes mirror a light: a map of the plane for each image of a light (lights/mirror_lights.py)."""

from pathlib import Path
from typing import Any

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.passes.light_maps import SHARE_TEXELS
from render_server.passes.light_table import LightTable


class MirrorSharesPass:
    """Fills the table's maps: shares without and with the objects, averaged over larger and larger footprints."""

    def __init__(self, gpu: GpuContext) -> None:
        self._program = ComputeProgram(gpu, Path(__file__).with_name("mirror_shares.comp.glsl"))

    def run(self, table: LightTable, noise_m: float, uniforms: dict[str, Any]) -> None:
        """Map every image of a light; lights, geometry and surfaces must be bound. `noise_m`: of depth, m."""
        count = len(table.mirrors)
        own = {"first_image": len(table.lights) - count, "bias_real": noise_m, "noise_m": noise_m}
        table.mirror_shares.bind_to_image(0, read=False, write=True)
        self._program.run((SHARE_TEXELS, SHARE_TEXELS, count), **{**uniforms, **own})
        table.mirror_shares.build_mipmaps()

    def release(self) -> None:
        """Free the GL objects."""
        self._program.release()
