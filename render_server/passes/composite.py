"""The relit picture: camera codes and linear radiance."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d
from render_server.passes.change_ratio import FILL_RADIUS, ChangeRatioPass
from render_server.passes.direct_light import DirectLightPass
from render_server.passes.light_table import LightTable
from render_server.passes.mirror_objects import RAY_ROUGHNESS
from render_server.passes.picture import Picture
from render_server.passes.rims import RIM_SIGHT
from render_server.passes.sampling_grid import SamplingGrid
from render_server.passes.trace_cones import ConeFields
from render_server.passes.volume import Pyramid, VolumePlacement


@dataclass(frozen=True)
class RelitLayers:
    """What a relighting method hands to composition; `pyramid` and `table` are there to be looked at."""

    matte: moderngl.Texture
    virtual_radiance: moderngl.Texture
    direct: DirectLightPass
    cones: ConeFields
    grid: SamplingGrid
    change: ChangeRatioPass
    pyramid: Pyramid
    placement: VolumePlacement
    table: LightTable
    reflection: moderngl.Texture | None = None
    """Objects in smooth real surfaces (passes/mirror_objects.py); None: such surfaces have the cones' reflection."""


class CompositePass:
    """Writes `code` (RGBA8UI, the camera's response applied) and `linear` (RGBA16F, camera units)."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._size = size
        self._threads = list_threads(gpu, size[0] * size[1])
        self.code = texture_2d(gpu, size, 4, "u1")
        self.linear = texture_2d(gpu, size, 4, "f2")
        defines = {"FILL_RADIUS": FILL_RADIUS, "RIM_SIGHT": RIM_SIGHT, "RAY_ROUGHNESS": RAY_ROUGHNESS}
        self._program = ComputeProgram(gpu, Path(__file__).with_name("composite.comp.glsl"), defines)

    def run(self, picture: Picture, layers: RelitLayers, uniforms: dict[str, Any]) -> None:
        """Compose; geometry and surfaces must be bound."""
        cones, direct = layers.cones, layers.direct
        bind_samplers(
            {
                0: layers.grid.pixels,
                1: picture.code,
                2: picture.linear,
                3: picture.inverse_response,
                8: layers.matte,
            }
            | {9: layers.virtual_radiance, 10: direct.mu, 11: direct.rho, 12: cones.mu, 13: cones.rho}
            | {14: cones.specular_mu, 16: cones.specular_rho, 17: direct.lobe_mu, 18: direct.lobe_rho}
            | {19: layers.change.ratio, 21: picture.rims}
        )
        self.code.write(picture.bytes, alignment=1)
        layers.change.texels.bind_to_storage_buffer(6)
        bind_images(self.code, self.linear)
        if layers.reflection is not None:
            layers.reflection.use(location=20)
        own = {
            "scale": layers.grid.scale,
            "exposure_scale": picture.exposure_scale,
            "has_reflection": layers.reflection is not None,
        }
        self._program.run((self._threads,), **own, **uniforms)

    def release(self) -> None:
        """Free the GL objects."""
        for item in (self.code, self.linear, self._program):
            item.release()
