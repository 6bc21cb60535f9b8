"""The camera's picture on the GPU: its codes, the response, and linear radiance."""

from pathlib import Path

import moderngl
import numpy as np

from protocol.frames import ViewFrame, decode_lut
from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d


class Picture:
    """Code (RGBA8UI), linear radiance in camera units with levels (RGBA16F), response (256 x 1), pixel rays."""

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._ctx = gpu.ctx
        self.size = size
        self.code = texture_2d(gpu, size, 4, "u1")
        self.linear = texture_2d(gpu, size, 4, "f2", linear=True)
        self.linear.build_mipmaps()
        self.linear.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        self.response = texture_2d(gpu, (256, 1), 4, "f4")
        self.rays = texture_2d(gpu, size, 2, "f4")
        self.exposure_scale = 1.0
        self._program = ComputeProgram(gpu, Path(__file__).with_name("linearize.comp.glsl"))
        self._rays_of: object = None

    def upload(self, frame: ViewFrame) -> None:
        """Take over a frame's picture and make it linear."""
        height, width, _ = frame.color.shape
        rgba = np.empty((height, width, 4), np.uint8)
        rgba[..., :3] = frame.color
        rgba[..., 3] = 255
        self.code.write(rgba.tobytes(), alignment=1)
        lut = np.ones((256, 4), np.float32)
        lut[:, :3] = decode_lut(frame.response)
        self.response.write(lut.tobytes(), alignment=1)
        if self._rays_of != frame.camera:
            self.rays.write(np.ascontiguousarray(frame.camera.rays(), np.float32).tobytes(), alignment=1)
            self._rays_of = frame.camera
        self.exposure_scale = frame.exposure_scale
        bind_samplers({0: self.code, 1: self.response})
        bind_images(self.linear)
        self._program.run(self.size, exposure_scale=frame.exposure_scale)

    def build_levels(self) -> None:
        """Area averages of the linear picture (for samples that cover several pixels)."""
        self.linear.build_mipmaps()
        self.linear.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)

    def release(self) -> None:
        """Free the GL objects."""
        for item in (self.code, self.linear, self.response, self.rays, self._program):
            item.release()
