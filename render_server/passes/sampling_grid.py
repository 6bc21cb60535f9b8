"""The reduced grid on which cones are traced: which pixel stands for each texel."""

from pathlib import Path
from typing import Any

import moderngl

from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d


class SamplingGrid:
    """RGBA16I: pixel of a real surface (x, y) and of a virtual one (x, y), -1 where the block shows none.

    Where objects hide the block's real surfaces, -2 - pixel stands for one of them.

    `virtual_texels` lists the texels that show an object (count, then indices).
    """

    def __init__(self, gpu: GpuContext, picture_size: tuple[int, int], scale: int) -> None:
        self.picture_size, self.scale = picture_size, scale
        self.size = (-(-picture_size[0] // scale), -(-picture_size[1] // scale))
        self.pixels = texture_2d(gpu, self.size, 4, "i2")
        self.virtual_texels = gpu.ctx.buffer(bytes(4 * (1 + self.size[0] * self.size[1])))
        self._program = ComputeProgram(gpu, Path(__file__).with_name("sampling_grid.comp.glsl"))

    def run(self, matte: moderngl.Texture, uniforms: dict[str, Any]) -> None:
        """Choose the pixels; needs the geometry buffers bound."""
        bind_samplers({0: matte})
        bind_images(self.pixels)
        self.virtual_texels.write(bytes(4))
        self.virtual_texels.bind_to_storage_buffer(6)
        self._program.run(self.size, picture_pixels=self.picture_size, scale=self.scale, **uniforms)

    def release(self) -> None:
        """Free the GL objects."""
        self.pixels.release()
        self.virtual_texels.release()
        self._program.release()
