"""The OpenGL context of a process (EGL, headless)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import moderngl

from protocol.errors import DeltalightError

SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swiftshader", "swrast")

# What EGL and the GL loader say, and what a user can do about it.
HINTS = {
    "libGL.so not loaded": "OpenGL is not installed: apt-get install --no-install-recommends libegl1 libgl1",
    "libEGL.so not loaded": "EGL is not installed: apt-get install --no-install-recommends libegl1 libgl1",
    "eglInitialize failed": "EGL found no driver: install libgl1-mesa-dri, or the NVIDIA driver's EGL library",
    "XOpenDisplay": "a display was asked for where none is: the EGL backend must be used",
    "eglCreateContext failed": "the driver offers less than OpenGL 4.3: update the graphics driver",
    "found 0 devices": "EGL sees no device: in a container, pass the GPU with its graphics capability",
    "requested device": "there is no such GPU: leave --device out, or see `deltalight doctor` for the list",
}


@dataclass(frozen=True)
class GpuContext:
    """A current OpenGL 4.3 context and its device.

    One process has one context and uses it from one thread.
    """

    ctx: moderngl.Context
    renderer_name: str
    version: str
    is_software: bool
    watchers: list[Callable[[Any], None]] = field(default_factory=list)
    """Told of every run of a kernel (gpu/kernel.py)."""
    compile_watchers: list[Callable[[str, Mapping[str, str]], None]] = field(default_factory=list)
    """Told of every program that is compiled: its label and the text of each of its stages."""

    def compiled(self, label: str, sources: Mapping[str, str]) -> None:
        """Tells the compile watchers about a program."""
        for watch in self.compile_watchers:
            watch(label, sources)

    @cached_property
    def _empty_textures(self) -> dict[tuple[type, str], Any]:
        return {}

    def empty_texture(self, kind: type, texels: str) -> Any:  # noqa: ANN401 (as the kind says)
        """A texture of zeros (`texels`: f, i or u) that stands where a kernel is given none."""
        if (kind, texels) not in self._empty_textures:
            makers: dict[type, tuple[Any, tuple[int, ...]]] = {
                moderngl.Texture: (self.ctx.texture, (1, 1)),
                moderngl.Texture3D: (self.ctx.texture3d, (1, 1, 1)),
                moderngl.TextureArray: (self.ctx.texture_array, (1, 1, 1)),
            }
            make, size = makers[kind]
            texture = make(size, 4, bytes(4), dtype=f"{texels}1")
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
            self._empty_textures[kind, texels] = texture
        return self._empty_textures[kind, texels]

    @cached_property
    def empty_buffer(self) -> moderngl.Buffer:
        """A buffer of zeros that stands where a kernel reads from none."""
        return self.ctx.buffer(bytes(256))

    @cached_property
    def discarded_buffer(self) -> moderngl.Buffer:
        """The buffer that stands where a kernel may write to none."""
        return self.ctx.buffer(bytes(256))

    def release(self) -> None:
        """Frees the context; nothing made from it may be used afterwards."""
        self.ctx.release()


def is_software_renderer(name: str) -> bool:
    """Whether the renderer string names a CPU rasteriser."""
    return any(word in name.lower() for word in SOFTWARE_RENDERERS)


def explain_context_failure(text: str) -> str:
    """Returns one sentence that explains the error text of a failed context creation."""
    for needle, hint in HINTS.items():
        if needle in text:
            return f"No OpenGL context ({text}): {hint}."
    return f"No OpenGL context ({text}): run `deltalight doctor` to see what is missing."


def create_context(device: int | None = None, *, allow_software: bool = True) -> GpuContext:
    """Creates the process's context on EGL device `device` (default: the driver's first).

    Raises:
        DeltalightError: there is no driver, no such device, or only a software renderer although none is
            allowed.
    """
    options: dict[str, Any] = {"standalone": True, "backend": "egl", "require": 430}
    if device is not None:
        options["device_index"] = device
    try:
        ctx = moderngl.create_context(**options)
    except Exception as error:  # moderngl and glcontext raise plain Exception
        raise DeltalightError(explain_context_failure(str(error))) from error
    name = str(ctx.info["GL_RENDERER"])
    software = is_software_renderer(name)
    if software and not allow_software:
        ctx.release()
        raise DeltalightError(
            f"Only the software renderer {name} was found: "
            "install a GPU driver, or add --allow-software to accept slow frames."
        )
    return GpuContext(ctx, name, str(ctx.info["GL_VERSION"]), software)
