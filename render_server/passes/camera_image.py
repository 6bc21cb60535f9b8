"""The camera's picture on the GPU: its codes, their linear radiance, and the ray of each pixel."""

import cv2
import moderngl
import numpy as np
from jaxtyping import Float32, UInt8

from deltalight.protocol.frames import ViewFrame, decode_lut
from deltalight.render_server.gpu.clearing import cleared_starts, take_used_up
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings
from deltalight.render_server.gpu.picture_kernel import PictureKernel
from deltalight.render_server.gpu.textures import release_all, texture_2d

INVERSE_SIZE = 8192  # steps of the inverse response: a code is at least 16 of them wide


class CameraImage:
    """Codes (RGBA8UI), their linear radiance in camera units (256 x 1), the same of every pixel with mip levels
    (RGBA16F), and pixel rays.
    """

    def __init__(self, gpu: GpuContext, size: tuple[int, int]) -> None:
        self.size = size
        self.code = texture_2d(gpu, size, 4, "u1")
        self.linear = texture_2d(gpu, size, 4, "f2", linear=True)
        self._has_levels = False  # of the picture that `linear` shows
        self.build_levels()
        self.code_radiance = texture_2d(gpu, (256, 1), 4, "f2")
        self.inverse_response = texture_2d(gpu, (INVERSE_SIZE, 1), 4, "f4")
        self.rays = texture_2d(gpu, size, 2, "f4")
        self.exposure_scale = 1.0
        self.codes = gpu.ctx.buffer(reserve=4 * size[0] * size[1], dynamic=True)  # as textures take them
        self.is_linear = False  # whether `linear` shows the picture that was uploaded last
        self._gpu = gpu
        self._linearize = PictureKernel(gpu, "linearize", **({} if gpu.is_software else {"CLEARS": 1}))
        self._rays_of: object = None
        self._response_of: object = None

    @property
    def bindings(self) -> dict[str, Binding]:
        """Linear radiance and pixel rays by GLSL name."""
        return {"linear_picture": self.linear, "picture_rays": self.rays}

    def upload(self, frame: ViewFrame) -> None:
        """Uploads a frame's picture; `linear` shows the one before until `linearize`."""
        self.is_linear = False
        self.codes.write(rgba(frame.color))
        self.code.write(self.codes, alignment=1)
        self._write_response(decode_lut(frame.response), frame.exposure_scale)
        if self._rays_of != frame.camera:
            self.rays.write(np.ascontiguousarray(frame.camera.rays(), np.float32).tobytes(), alignment=1)
            self._rays_of = frame.camera

    def linearize(self, *, begins_frame: bool = False) -> None:
        """Computes the linear radiance of the picture that was uploaded last, once.

        `begins_frame`: on a GPU, also clears what the frames before have used up (`clear_ahead`).
        """
        if self.is_linear:
            return
        self.is_linear, self._has_levels = True, False
        cleared: Bindings = {}
        if not self._gpu.is_software:
            cleared = take_used_up(self._gpu) if begins_frame else cleared_starts()
        self._linearize.run(
            (0, 0, *self.size),
            cleared,
            picture=self.code,
            code_radiance=self.code_radiance,
            linear_out=self.linear,
        )

    def _write_response(self, decode: Float32[np.ndarray, "256 3"], exposure_scale: float) -> None:
        """Uploads the radiance of the codes and its inverse, unless they are the same as before."""
        is_same = decode is self._response_of
        if is_same and exposure_scale == self.exposure_scale:
            return
        self._response_of, self.exposure_scale = decode, exposure_scale
        radiance = np.ones((256, 4), np.float16)
        radiance[:, :3] = decode / np.float32(exposure_scale)
        self.code_radiance.write(radiance.tobytes(), alignment=1)
        if not is_same:  # exposure may change with every frame, and the inverse takes a millisecond
            self.inverse_response.write(inverse_response(decode).tobytes(), alignment=1)

    def build_levels(self) -> None:
        """Builds the mip levels of the linear picture (for samples that cover several pixels), once."""
        if self._has_levels:
            return
        self._has_levels = True
        self.linear.build_mipmaps()
        self.linear.filter = (moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR)

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(
            self.code,
            self.codes,
            self.linear,
            self.code_radiance,
            self.inverse_response,
            self.rays,
            self._linearize,
        )


def rgba(color: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 4"]:
    """Returns a picture as the texels of an opaque RGBA texture."""
    return np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2RGBA))


def inverse_response(decode: Float32[np.ndarray, "256 3"]) -> Float32[np.ndarray, "n 4"]:
    """Returns the code with the nearest linear value, for the squares of INVERSE_SIZE even steps from 0 to 1."""
    values = np.linspace(0.0, 1.0, INVERSE_SIZE) ** 2
    table = np.ones((INVERSE_SIZE, 4), np.float32)
    for channel in range(3):
        between = 0.5 * (decode[1:, channel] + decode[:-1, channel])
        table[:, channel] = np.searchsorted(between, values)
    return table
