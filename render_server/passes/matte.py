"""Share of each pixel that the virtual objects cover."""

from pathlib import Path
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d
from render_server.passes.picture import Picture
from render_server.view import Rectangle


class MattePass:
    """R16F matte on the picture's grid, and a list (common/texel_list.glsl) of pixels at `edges` of real things.

    Needs the geometry buffers bound.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._size = size
        self.texture = texture_2d(gpu, size, 1, "f2")
        self.edges = gpu.ctx.buffer(bytes(4 * (1 + size[0] * size[1])))
        self._program = ComputeProgram(gpu, Path(__file__).with_name("matte.comp.glsl"))

    def run(
        self,
        picture: Picture,
        rectangle: Rectangle,
        uniforms: dict[str, Any],
        coverage: moderngl.Texture | None = None,
    ) -> None:
        """Compare depths, soften along the picture's edges, in the `rectangle`.

        `coverage`: of samples (passes/coverage.py); None: the geometry buffer has one sample a pixel.
        """
        self.texture.write(bytes(2 * self._size[0] * self._size[1]), alignment=1)
        self.edges.write(bytes(4))
        x, y, width, height = rectangle
        if width <= 0 or height <= 0:
            return
        bind_samplers({1: picture.linear} if coverage is None else {1: picture.linear, 2: coverage})
        self.edges.bind_to_storage_buffer(6)
        bind_images(self.texture)
        self._program.run((width, height), first_pixel=(x, y), antialiased=coverage is not None, **uniforms)

    def release(self) -> None:
        """Free the GL objects."""
        for item in (self.texture, self.edges, self._program):
            item.release()
