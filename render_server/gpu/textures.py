"""Textures with the sampling state that every pass uses; reading single texels; freeing GL objects."""

from typing import Protocol

import moderngl
import numpy as np
from jaxtyping import Float32

from render_server.gpu.context import GpuContext


class Releasable(Protocol):
    """A GL object, or an owner of some."""

    def release(self) -> None:
        """Frees it."""


def texture_2d(
    gpu: GpuContext,
    size: tuple[int, int],
    components: int,
    dtype: str,
    *,
    linear: bool = False,
    data: bytes | None = None,
) -> moderngl.Texture:
    """Creates a texture of `size` (width, height), clamped at its edges; nearest unless `linear`."""
    texture = gpu.ctx.texture(size, components, data, dtype=dtype, alignment=1)
    mode = moderngl.LINEAR if linear else moderngl.NEAREST
    if dtype[0] == "f":
        texture.filter = (mode, mode)
    texture.repeat_x = texture.repeat_y = False
    return texture


def read_texel(texture: moderngl.Texture, place: tuple[int, int]) -> Float32[np.ndarray, " c"]:
    """Returns the components of the texel at `place` (column, row); waits until the GPU has written it."""
    target = texture.ctx.framebuffer([texture])
    try:
        data = target.read(viewport=(*place, 1, 1), components=texture.components, dtype="f4", alignment=1)
    finally:
        release_target(target)
    return np.frombuffer(data, np.float32)


def release_target(target: moderngl.Framebuffer) -> None:
    """Frees a framebuffer; unbinds it first, or creating the next one would raise a GL error."""
    target.ctx.detect_framebuffer(0).use()
    target.release()


def release_all(*items: Releasable | None) -> None:
    """Frees all items except None."""
    for item in items:
        if item is not None:
            item.release()
