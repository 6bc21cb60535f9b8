"""The camera's picture on the GPU: its codes, the response, and linear radiance."""

from pathlib import Path

import moderngl
import numpy as np
from jaxtyping import Float32

from protocol.frames import ViewFrame, decode_lut
from render_server.gpu.context import GpuContext
from render_server.gpu.program import ComputeProgram
from render_server.gpu.textures import bind_images, bind_samplers, texture_2d

INVERSE_SIZE = 8192  # steps of the inverse response: a code is at least 16 of them wide


class Picture:
    """Code (RGBA8UI), linear radiance in camera units with levels (RGBA16F), response (256 x 1), pixel rays.

    `rims` (RGBA16F, by passes/rims.py): what takes the old background out of a pixel's radiance at the rim of a real
    thing before an object, and which pixel shows that thing's surface.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self._ctx = gpu.ctx
        self.size = size
        self.code = texture_2d(gpu, size, 4, "u1")
        self.linear = texture_2d(gpu, size, 4, "f2", linear=True)
        self.linear.build_mipmaps()
        self.linear.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)
        self.response = texture_2d(gpu, (256, 1), 4, "f4")
        self.inverse_response = texture_2d(gpu, (INVERSE_SIZE, 1), 4, "f4")
        self.rays = texture_2d(gpu, size, 2, "f4")
        self.rims = texture_2d(gpu, size, 4, "f2")
        self.exposure_scale = 1.0
        self.bytes = b""
        self._program = ComputeProgram(gpu, Path(__file__).with_name("linearize.comp.glsl"))
        self._rays_of: object = None
        self._response_of: object = None

    def upload(self, frame: ViewFrame) -> None:
        """Take over a frame's picture and make it linear."""
        height, width, _ = frame.color.shape
        rgba = np.empty((height, width, 4), np.uint8)
        rgba[..., :3] = frame.color
        rgba[..., 3] = 255
        self.bytes = rgba.tobytes()
        self.code.write(self.bytes, alignment=1)
        self._write_response(decode_lut(frame.response))
        if self._rays_of != frame.camera:
            self.rays.write(np.ascontiguousarray(frame.camera.rays(), np.float32).tobytes(), alignment=1)
            self._rays_of = frame.camera
        self.exposure_scale = frame.exposure_scale
        bind_samplers({0: self.code, 1: self.response})
        bind_images(self.linear)
        self._program.run(self.size, exposure_scale=frame.exposure_scale)

    def _write_response(self, decode: Float32[np.ndarray, "256 3"]) -> None:
        """Upload the response and its inverse, unless they are the same as before."""
        if decode is self._response_of:
            return
        self._response_of = decode
        lut = np.ones((256, 4), np.float32)
        lut[:, :3] = decode
        self.response.write(lut.tobytes(), alignment=1)
        self.inverse_response.write(inverse_response(decode).tobytes(), alignment=1)

    def build_levels(self) -> None:
        """Area averages of the linear picture (for samples that cover several pixels)."""
        self.linear.build_mipmaps()
        self.linear.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)

    def release(self) -> None:
        """Free the GL objects."""
        textures = self.code, self.linear, self.response, self.inverse_response, self.rays, self.rims
        for item in (*textures, self._program):
            item.release()


def inverse_response(decode: Float32[np.ndarray, "256 3"]) -> Float32[np.ndarray, "n 4"]:
    """Code whose linear value is nearest, for the squares of INVERSE_SIZE even steps from 0 to 1."""
    values = np.linspace(0.0, 1.0, INVERSE_SIZE) ** 2
    table = np.ones((INVERSE_SIZE, 4), np.float32)
    for channel in range(3):
        between = 0.5 * (decode[1:, channel] + decode[:-1, channel])
        table[:, channel] = np.searchsorted(between, values)
    return table
