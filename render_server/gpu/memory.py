"""GPU memory of Python objects: finds the textures and buffers in their attributes and sums their bytes."""

import math
from collections.abc import Iterator, Sequence

import moderngl

from render_server.gpu.context import GpuContext

GPU_KINDS = (moderngl.Texture, moderngl.Texture3D, moderngl.TextureArray, moderngl.Buffer)
OWN_CODE = "render_server."
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
        yield from vars(value).values()


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
