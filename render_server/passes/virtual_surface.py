"""Radiance of the virtual surfaces."""

from pathlib import Path
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram, list_threads
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d
from render_server.passes.geometry_buffer import GeometryBuffer
from render_server.passes.sampling_grid import SamplingGrid
from render_server.passes.trace_cones import ConeFields


class VirtualSurfacePass:
    """RGBA16F radiance on the picture's grid, where the matte is above zero."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._threads = list_threads(gpu, size[0] * size[1])
        self.radiance = texture_2d(gpu, size, 4, "f2")
        self._program = ComputeProgram(gpu, Path(__file__).with_name("virtual_surface.comp.glsl"))

    def run(
        self,
        matte: moderngl.Texture,
        raster: GeometryBuffer,
        cones: ConeFields,
        grid: SamplingGrid,
        uniforms: dict[str, Any],
        *,
        screen: moderngl.Texture | None = None,
    ) -> None:
        """Shade; lights, materials and geometry must be bound. `screen`: of passes/screen_cones.py, if it ran."""
        bind_samplers(
            {
                0: grid.pixels,
                1: matte,
                2: cones.virtual,
                3: cones.virtual_specular,
                8: raster.uv,
                9: raster.tint,
            }
        )
        if screen is not None:
            screen.use(location=16)
        bind_images(self.radiance)
        grid.virtual_texels.bind_to_storage_buffer(6)
        own = {"scale": grid.scale, "has_screen_reflection": screen is not None}
        self._program.run((self._threads,), **own, **uniforms)

    def release(self) -> None:
        """Free the GL objects."""
        self.radiance.release()
        self._program.release()
