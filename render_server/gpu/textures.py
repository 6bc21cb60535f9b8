"""Making textures with the sampling state that every pass here wants."""

from collections.abc import Mapping

import moderngl

from render_server.gpu.context import GpuContext


def texture_2d(
    gpu: GpuContext,
    size: tuple[int, int],
    components: int,
    dtype: str,
    *,
    linear: bool = False,
    data: bytes | None = None,
) -> moderngl.Texture:
    """Texture of `size` (width, height), clamped at its edges; nearest unless `linear`."""
    texture = gpu.ctx.texture(size, components, data, dtype=dtype, alignment=1)
    mode = moderngl.LINEAR if linear else moderngl.NEAREST
    if dtype[0] == "f":
        texture.filter = (mode, mode)
    texture.repeat_x = texture.repeat_y = False
    return texture


def bind_images(*textures: moderngl.Texture | moderngl.Texture3D, first: int = 0) -> None:
    """Bind textures as read-write images of their own format, on units from `first` on."""
    for unit, texture in enumerate(textures, start=first):
        texture.bind_to_image(unit, read=True, write=True)


def bind_samplers(
    textures: Mapping[int, moderngl.Texture | moderngl.Texture3D | moderngl.TextureArray],
) -> None:
    """Bind textures to sampler units."""
    for unit, texture in textures.items():
        texture.use(location=unit)


def release_target(target: moderngl.Framebuffer) -> None:
    """Free a framebuffer; a bound one is unbound first, or the next one made would meet a GL error."""
    target.ctx.detect_framebuffer(0).use()
    target.release()
