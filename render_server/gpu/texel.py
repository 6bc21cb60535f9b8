"""Reading one texel of a texture, for questions that people ask about a picture."""

import moderngl
import numpy as np
from jaxtyping import Float32

from render_server.gpu.textures import release_target


def read_texel(texture: moderngl.Texture, place: tuple[int, int]) -> Float32[np.ndarray, " c"]:
    """Components of the texel at `place` (column, row); waits until the GPU has filled it."""
    target = texture.ctx.framebuffer([texture])
    try:
        data = target.read(viewport=(*place, 1, 1), components=texture.components, dtype="f4", alignment=1)
    finally:
        release_target(target)
    return np.frombuffer(data, np.float32)
