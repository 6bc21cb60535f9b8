"""Antialiased edges of the objects before each other."""

from pathlib import Path

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d
from render_server.passes.coverage import CoveragePass
from render_server.view import Rectangle


class InnerEdgesPass:
    """RGBA16F radiance of the objects, mixed where a pixel's samples show two of their surfaces."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.radiance = texture_2d(gpu, size, 4, "f2")
        self._program = ComputeProgram(gpu, Path(__file__).with_name("inner_edges.comp.glsl"))

    def run(self, radiance: moderngl.Texture, coverage: CoveragePass, rectangle: Rectangle) -> None:
        """Mix `radiance`, shaded at the samples that stand for their pixels."""
        surface = coverage.surface
        bind_samplers({0: radiance, 1: coverage.texture, 2: coverage.other})
        bind_samplers({6: surface.position, 7: surface.normal})
        bind_images(self.radiance)
        self._program.run(rectangle[2:], rectangle=rectangle)

    def release(self) -> None:
        """Free the GL objects."""
        self.radiance.release()
        self._program.release()
