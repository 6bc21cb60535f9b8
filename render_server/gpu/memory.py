"""GPU memory of Python objects: finds the textures and buffers in their attributes and sums their bytes."""

import math
from collections.abc import Iterator

import moderngl
import numpy as np

GPU_KINDS = (moderngl.Texture, moderngl.Texture3D, moderngl.TextureArray, moderngl.Buffer)
OWN_CODE = "render_server."
DEEPEST = 4  # nested attributes: a pass holds fields, which hold textures


def gpu_objects(value: object, depth: int = 0) -> Iterator[object]:
    """Yields the textures and buffers that `value` is or holds; those held twice come twice."""
    if isinstance(value, GPU_KINDS):
        yield value
    elif depth < DEEPEST:
        for item in _parts(value):
            yield from gpu_objects(item, depth + 1)


def _parts(value: object) -> Iterator[object]:
    if isinstance(value, tuple | list):
        yield from value
    elif isinstance(value, dict):
        yield from value.values()
    elif type(value).__module__.startswith(OWN_CODE) and hasattr(value, "__dict__"):
        yield from vars(value).values()


def size_bytes(value: object) -> int:
    """Returns the bytes of GPU memory that `value` holds, without mip levels."""
    held = {id(item): item for item in gpu_objects(value)}
    return sum(_size(item) for item in held.values())


def _size(item: object) -> int:
    if isinstance(item, moderngl.Buffer):
        return int(item.size)
    assert isinstance(item, moderngl.Texture | moderngl.Texture3D | moderngl.TextureArray)
    texels = math.prod(item.size)
    return int(texels * item.components * np.dtype(item.dtype).itemsize)
