"""Storage buffers that a kernel takes as images (gpu/texel_images.py): moderngl does not know buffer textures."""

import ctypes
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from typing import Any, Final
from weakref import ref

import moderngl

TEXTURE_BUFFER, READ_WRITE = 0x8C2A, 0x88BA  # OpenGL's numbers, as those below
BUFFER_IMAGES: Final = frozenset({0x9051, 0x905C, 0x9067})  # types imageBuffer, iimageBuffer, uimageBuffer
FORMATS: Final[Mapping[str, int]] = {
    "r32f": 0x822E,
    "rg32f": 0x8230,
    "rgba32f": 0x8814,
    "r32i": 0x8235,
    "r32ui": 0x8236,
    "rg32ui": 0x823C,
}
_UINT, _UINTS = ctypes.c_uint, ctypes.POINTER(ctypes.c_uint)
_ARGUMENTS: Final[Mapping[str, tuple[Any, ...]]] = {
    "glGenTextures": (ctypes.c_int, _UINTS),
    "glDeleteTextures": (ctypes.c_int, _UINTS),
    "glBindTexture": (_UINT, _UINT),
    "glTexBuffer": (_UINT, _UINT, _UINT),
    "glBindImageTexture": (_UINT, _UINT, ctypes.c_int, ctypes.c_ubyte, ctypes.c_int, _UINT, _UINT),
}


class TextureCalls:
    """OpenGL's functions for textures, by name."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self._load: Callable[[str], int] = ctx.mglo._context.load

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 (a function of ctypes)
        function = ctypes.CFUNCTYPE(None, *_ARGUMENTS[name])(self._load(name))
        setattr(self, name, function)
        return function


class BufferImage:
    """A texture that shows a storage buffer's data as texels of a format at an image unit."""

    def __init__(self, calls: TextureCalls, unit: int, texels: str) -> None:
        self._calls, self._unit, self._format = calls, unit, FORMATS[texels]
        self._shown: Callable[[], moderngl.Buffer | None] = lambda: None
        self._size = 0

    @cached_property
    def _name(self) -> int:
        name = _UINT()
        self._calls.glGenTextures(1, ctypes.byref(name))
        return name.value

    @cached_property
    def _attach(self) -> Callable[[], None]:
        """Attaches the texture to the unit; arguments are converted once, for that takes longer than the call."""
        level, layered, layer = 0, 0, 0
        values = self._unit, self._name, level, layered, layer, READ_WRITE, self._format
        kinds = _ARGUMENTS["glBindImageTexture"]
        given = [kind(value) for kind, value in zip(kinds, values, strict=True)]
        return partial(self._calls.glBindImageTexture, *given)

    def bind(self, buffer: moderngl.Buffer) -> None:
        """Binds the data of `buffer` to the unit."""
        size = buffer.size
        if self._shown() is not buffer or self._size != size:
            self._calls.glBindTexture(TEXTURE_BUFFER, self._name)
            self._calls.glTexBuffer(TEXTURE_BUFFER, self._format, buffer.glo)
            self._shown, self._size = ref(buffer), size
        self._attach()

    def release(self) -> None:
        """Frees the texture."""
        if "_name" in self.__dict__:
            self._calls.glDeleteTextures(1, ctypes.byref(_UINT(self.__dict__.pop("_name"))))
