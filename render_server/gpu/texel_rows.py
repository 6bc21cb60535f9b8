"""Records that shaders read from a texture, row after row, of which only rows that changed are uploaded."""

import moderngl
import numpy as np
from jaxtyping import Float32

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.textures import release_all, texture_2d, texture_rows


class TexelRows:
    """Texels of four components of 32 bits, written on the CPU and uploaded when the texture is asked for.

    `width` is that of a row; `dtype` is moderngl's: "f4", or "u4" for bits of floats and integers.
    """

    def __init__(self, gpu: GpuContext, width: int, dtype: str) -> None:
        self._gpu, self._width, self._dtype = gpu, width, dtype
        self._texels = np.zeros((0, width, 4), np.float32)
        self._is_stale = np.zeros(2, bool)  # of each row on the GPU, between two that are none
        self._texture: moderngl.Texture | None = None

    def reserve(self, count: int) -> None:
        """Makes room for that many texels; those that find room stay."""
        rows = texture_rows(-(-count // self._width))
        if rows == len(self._texels):
            return
        before = self._texels[:rows]
        self._texels = np.zeros((rows, self._width, 4), np.float32)
        self._texels[: len(before)] = before
        self._is_stale = np.zeros(rows + 2, bool)
        self._is_stale[1:-1] = True

    def renewed(self, first: int, count: int) -> Float32[np.ndarray, "count 4"]:
        """Returns texels to be written in place."""
        self._is_stale[1 + first // self._width : 1 - (-(first + count) // self._width)] = True
        return self._texels.reshape(-1, 4)[first : first + count]

    @property
    def texture(self) -> moderngl.Texture:
        """The texture, brought up to date."""
        size = self._width, len(self._texels)
        if self._texture is None or self._texture.size != size:
            release_all(self._texture)
            self._texture = texture_2d(self._gpu, size, 4, self._dtype)
        ends = np.flatnonzero(self._is_stale[1:] != self._is_stale[:-1])
        for first, last in ends.reshape(-1, 2).tolist():
            self._texture.write(self._texels[first:last], (0, first, self._width, last - first), alignment=1)
        self._is_stale[:] = False
        return self._texture

    def release(self) -> None:
        """Frees the texture."""
        release_all(self._texture)
