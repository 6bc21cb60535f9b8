"""Views for people who look inside: they replace the composite's codes."""

from pathlib import Path
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers
from render_server.passes.light_table import LightTable
from render_server.passes.picture import Picture
from render_server.passes.volume import Pyramid, VolumePlacement

FOLDER = Path(__file__).parent


class ViewPasses:
    """Effects, delta, volume and reflective shadow maps, each written into `code` (RGBA8UI)."""

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._programs: dict[str, ComputeProgram] = {}

    def _program(self, name: str, file: str, **defines: int) -> ComputeProgram:
        if name not in self._programs:
            self._programs[name] = ComputeProgram(self._gpu, FOLDER / file, defines)
        return self._programs[name]

    def change(
        self,
        code: moderngl.Texture,
        picture: Picture,
        relit: moderngl.Texture,
        matte: moderngl.Texture,
        *,
        effects: bool,
    ) -> None:
        """Signed change of light, or the effects on grey."""
        defines = {"EFFECTS": 1} if effects else {}
        program = self._program("effects" if effects else "delta", "delta_view.comp.glsl", **defines)
        bind_samplers({0: picture.linear, 1: relit, 2: matte})
        bind_images(code)
        program.run(picture.size)

    def volume(
        self,
        code: moderngl.Texture,
        picture: Picture,
        pyramid: Pyramid,
        placement: VolumePlacement,
        uniforms: dict[str, Any],
    ) -> None:
        """Voxels as cubes; `uniforms` are the camera's."""
        name = f"volume {pyramid.directions}"
        program = self._program(name, "volume_view.comp.glsl", DIRECTIONS=pyramid.directions)
        bind_samplers({0: picture.code, 1: picture.rays, 2: pyramid.texture})
        bind_images(code)
        program.run(picture.size, **placement.uniforms(), **uniforms)

    def shadow_maps(self, code: moderngl.Texture, table: LightTable) -> None:
        """Real maps left, virtual maps right."""
        program = self._program("rsm", "rsm_view.comp.glsl")
        real, virtual = table.real_atlas, table.virtual_atlas
        bind_samplers({0: real.normal, 1: virtual.normal, 2: real.depth, 3: virtual.depth})
        bind_images(code)
        program.run(code.size)

    def release(self) -> None:
        """Free the programs."""
        for program in self._programs.values():
            program.release()
