"""Textures: made in one place, read back without stalling the GPU, and measured in bytes."""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any, Final, Protocol

import moderngl
import numpy as np
from jaxtyping import Float, Float32, Float64

from deltalight.render_server.gpu.context import GpuContext

IMAGE_FORMATS: Final = {  # by type and number of components
    "f1": {1: "r8", 2: "rg8", 4: "rgba8"},
    "f2": {1: "r16f", 2: "rg16f", 4: "rgba16f"},
    "f4": {1: "r32f", 2: "rg32f", 4: "rgba32f"},
    "u1": {1: "r8ui", 2: "rg8ui", 4: "rgba8ui"},
    "i2": {1: "r16i", 2: "rg16i", 4: "rgba16i"},
    "u4": {1: "r32ui", 2: "rg32ui", 4: "rgba32ui"},
}


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
    """Creates a texture of `size` (width, height), clamped at its edges; nearest unless `linear`.

    It holds zeros where `data` is None. OpenGL promises nothing: Mesa clears it, NVIDIA leaves what was there, and
    passes that write only texels of a work list would read that.
    """
    texel_bytes = components * int(dtype[1])
    zeros = None if data else bytes(size[0] * size[1] * texel_bytes)
    texture = gpu.ctx.texture(size, components, data or zeros, dtype=dtype, alignment=1)
    mode = moderngl.LINEAR if linear else moderngl.NEAREST
    if dtype[0] == "f":
        texture.filter = (mode, mode)
    texture.repeat_x = texture.repeat_y = False
    return texture


def texture_rows(count: int) -> int:
    """Returns how many rows a texture of `count` rows of records or triangles gets: a multiple of three.

    Mesa's llvmpipe compiles all kernels that read a texture anew where its height becomes a power of two, or is no
    longer one, as with a lamp or an object more; no multiple of three is one.
    """
    return 3 * max(1, -(-count // 3))


def texture_3d(
    gpu: GpuContext, size: tuple[int, int, int], components: int, dtype: str
) -> moderngl.Texture3D:
    """Creates a texture of zeros of `size` (width, height, depth), clamped at its borders, nearest."""
    zeros = bytes(math.prod(size) * components * int(dtype[1]))
    texture = gpu.ctx.texture3d(size, components, zeros, dtype=dtype, alignment=1)
    texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
    texture.repeat_x = texture.repeat_y = texture.repeat_z = False
    return texture


def image_format(texture: moderngl.Texture | moderngl.Texture3D | moderngl.TextureArray) -> str:
    """Returns the format layout qualifier (GLSL 4.30) of the texels; "no image format" if GLSL has none for them."""
    return IMAGE_FORMATS.get(texture.dtype, {}).get(texture.components, "no image format")


def texels_of(image_format: str) -> tuple[str, int]:
    """Returns type and number of components of texels that have a format layout qualifier."""
    places = ((dtype, count, name) for dtype, names in IMAGE_FORMATS.items() for count, name in names.items())
    return next((dtype, count) for dtype, count, name in places if name == image_format)


def read_texel(texture: moderngl.Texture, place: tuple[int, int]) -> Float32[np.ndarray, " c"]:
    """Returns the components of the texel at `place` (column, row); waits until the GPU has written it."""
    target = texture.ctx.framebuffer([texture])
    try:
        data = target.read(viewport=(*place, 1, 1), components=texture.components, dtype="f4", alignment=1)
    finally:
        release_target(target)
    return np.frombuffer(data, np.float32)


def read_texture(texture: moderngl.Texture) -> Float64[np.ndarray, "h w c"]:
    """Returns the contents of a half-float or float texture; waits until the GPU has written it."""
    return read_texels(texture).astype(np.float64)


def read_texels(texture: moderngl.Texture) -> Float[np.ndarray, "h w c"]:
    """Returns the contents of a half-float or float texture in its own type; waits until the GPU has written it."""
    width, height = texture.size
    dtype = np.float16 if texture.dtype == "f2" else np.float32
    return np.frombuffer(texture.read(), dtype).reshape(height, width, -1)


def release_target(target: moderngl.Framebuffer) -> None:
    """Frees a framebuffer; unbinds it first, or creating the next one would raise a GL error."""
    target.ctx.detect_framebuffer(0).use()
    target.release()


def release_all(*items: Releasable | None) -> None:
    """Frees all items except None."""
    for item in items:
        if item is not None:
            item.release()


GPU_KINDS = (moderngl.Texture, moderngl.Texture3D, moderngl.TextureArray, moderngl.Buffer)
OWN_CODE = "deltalight.render_server."
DEEPEST = 4  # attributes of attributes; a pass holds fields, which hold textures


def gpu_objects(value: object, depth: int = 0) -> Iterator[object]:
    """Textures and buffers that `value` is or holds; one that is held twice comes twice.

    What a context holds belongs to everybody, and so to nothing that knows the context.
    """
    if isinstance(value, GPU_KINDS):
        yield value
    elif depth < DEEPEST:
        for item in _parts(value):
            yield from gpu_objects(item, depth + 1)


def _parts(value: object) -> Iterator[object]:
    if isinstance(value, GpuContext):
        return
    if isinstance(value, tuple | list):
        yield from value
    elif isinstance(value, dict):
        yield from value.values()
    elif type(value).__module__.startswith(OWN_CODE) and hasattr(value, "__dict__"):
        yield from tuple(vars(value).values())  # another thread may fill a cached property meanwhile


def sizes_bytes(values: Sequence[object]) -> list[int]:
    """Bytes of the GPU's memory that each value takes, mip levels left out; nothing is counted twice.

    What several hold counts for the one of them that holds the fewest things, the first of those.
    """
    held = [{id(item): item for item in gpu_objects(value)} for value in values]
    owners: dict[int, int] = {}
    for index in sorted(range(len(held)), key=lambda index: len(held[index])):
        for key in held[index]:
            owners.setdefault(key, index)
    return [
        sum(_size(item) for key, item in each.items() if owners[key] == index)
        for index, each in enumerate(held)
    ]


def _size(item: object) -> int:
    if isinstance(item, moderngl.Buffer):
        return int(item.size)
    assert isinstance(item, moderngl.Texture | moderngl.Texture3D | moderngl.TextureArray)
    component_bytes = int(item.dtype[-1])  # of moderngl's f1, f2, u4, ...
    return int(math.prod(item.size) * item.components) * component_bytes


RING = 3


class AsyncReadback:
    """Copies textures into pixel buffers immediately and returns their bytes later, oldest first."""

    def __init__(self, gpu: GpuContext) -> None:
        self._ctx = gpu.ctx
        self._free: list[moderngl.Buffer] = []
        self._waiting: deque[tuple[moderngl.Buffer, tuple[int, int, int], np.dtype[Any]]] = deque()

    def __len__(self) -> int:
        return len(self._waiting)

    def push(self, texture: moderngl.Texture, dtype: str) -> None:
        """Starts copying `texture` (level 0, as `dtype` elements)."""
        width, height = texture.size
        shape = (height, width, texture.components)
        buffer = self._take(math.prod(shape) * np.dtype(dtype).itemsize)
        texture.read_into(buffer, alignment=1)
        self._waiting.append((buffer, shape, np.dtype(dtype)))

    def pop(self) -> np.ndarray[Any, Any]:
        """Returns the oldest pushed texture (h, w, components); waits only if the GPU has not finished it."""
        buffer, shape, dtype = self._waiting.popleft()
        array = np.frombuffer(buffer.read(math.prod(shape) * dtype.itemsize), dtype).reshape(shape)
        self._free.append(buffer)
        return array

    def _take(self, size: int) -> moderngl.Buffer:
        """Returns an idle buffer of `size` bytes."""
        for index, buffer in enumerate(self._free):
            if buffer.size == size:
                return self._free.pop(index)
        while len(self._free) >= RING:
            self._free.pop(0).release()
        return self._ctx.buffer(reserve=size, dynamic=True)

    def release(self) -> None:
        """Frees all buffers."""
        for buffer in [*self._free, *(entry[0] for entry in self._waiting)]:
            buffer.release()
        self._free.clear()
        self._waiting.clear()


class DelayedRead:
    """First bytes of a buffer as they were in the last frame but one, for which nobody waits: by now it is done."""

    def __init__(self, gpu: GpuContext, size: int) -> None:
        self._ctx, self._size = gpu.ctx, size
        self._free: list[moderngl.Buffer] = []
        self._waiting: deque[moderngl.Buffer] = deque()

    def push(self, source: moderngl.Buffer) -> None:
        """Copies the first bytes of `source`; once a frame."""
        copy = self._free.pop() if self._free else self._ctx.buffer(reserve=self._size, dynamic=True)
        self._ctx.copy_buffer(copy, source, self._size)
        self._waiting.append(copy)

    def pop(self) -> bytes | None:
        """Returns what was pushed in the last frame but one; once, before the frame pushes. None: nothing."""
        if len(self._waiting) < RING - 1:
            return None
        copy = self._waiting.popleft()
        self._free.append(copy)
        return copy.read(self._size)

    def forget(self) -> None:
        """Forgets what was pushed."""
        self._free += self._waiting
        self._waiting.clear()

    def release(self) -> None:
        """Frees the copies."""
        self.forget()
        release_all(*self._free)
        self._free.clear()
