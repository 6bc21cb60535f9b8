"""Uniform blocks (std140): values shared by many programs, declared once in GLSL and once as a dataclass."""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Annotated, Any, Generic, TypeVar, get_type_hints

import numpy as np

from deltalight.render_server.gpu.context import GpuContext

Bool = Annotated[bool, "bool"]
Int = Annotated[int, "int"]
Float = Annotated[float, "float"]
Vec2 = Annotated[Sequence[float] | np.ndarray[Any, Any], "vec2"]
Vec3 = Annotated[Sequence[float] | np.ndarray[Any, Any], "vec3"]
Vec4 = Annotated[Sequence[float] | np.ndarray[Any, Any], "vec4"]
Mat4 = Annotated[np.ndarray[Any, Any], "mat4"]
"""Row-major here, as everywhere in Python."""

# GLSL type: alignment and size in bytes (OpenGL 4.6 core, 7.6.2.2), format of its elements.
STD140 = {
    "bool": (4, 4, "I"),
    "int": (4, 4, "i"),
    "float": (4, 4, "f"),
    "vec2": (8, 8, "2f"),
    "vec3": (16, 12, "3f"),
    "vec4": (16, 16, "4f"),
    "mat4": (16, 64, "16f"),
}
SCALARS = ("bool", "int", "float")
ALIGNMENT = 16  # of blocks, bytes


_MEMBERS: dict[type, tuple[tuple[str, str], ...]] = {}
_LAYOUTS: dict[type, struct.Struct] = {}


@dataclass(frozen=True, eq=False)
class Block:
    """Base of a block's dataclass: its annotated fields are the block's members in order."""

    @classmethod
    def members(cls) -> tuple[tuple[str, str], ...]:
        """Returns name and GLSL type of each member."""
        if cls not in _MEMBERS:
            hints = get_type_hints(cls, include_extras=True)
            _MEMBERS[cls] = tuple((item.name, hints[item.name].__metadata__[0]) for item in fields(cls))
        return _MEMBERS[cls]

    def packed(self) -> bytes:
        """Returns the block's bytes."""
        values: list[float] = []
        for name, kind in self.members():
            value = getattr(self, name)
            if kind == "mat4":
                values.extend(np.asarray(value, np.float32).T.ravel().tolist())
            elif kind in SCALARS:
                values.append(value)
            else:
                values.extend(value)
        return self._layout().pack(*values)

    @classmethod
    def _layout(cls) -> struct.Struct:
        """Returns the members' formats with the gaps between them and after the last."""
        if cls not in _LAYOUTS:
            form = "<"
            for align, _, each in [*(STD140[kind] for _, kind in cls.members()), (ALIGNMENT, 0, "")]:
                form += f"{-struct.calcsize(form) % align}x{each}"
            _LAYOUTS[cls] = struct.Struct(form)
        return _LAYOUTS[cls]


Kind = TypeVar("Kind", bound=Block)


class UniformBlock(Generic[Kind]):
    """The GPU buffer of one block; rewritten when the value changes."""

    def __init__(self, gpu: GpuContext, value: Kind) -> None:
        self.value = value
        self._data = value.packed()
        self._buffer = gpu.ctx.buffer(self._data, dynamic=True)
        self.mglo: object = self._buffer.mglo  # what moderngl holds of the buffer

    @property
    def size(self) -> int:
        """Size in bytes."""
        return len(self._data)

    def fits(self, declared: int) -> bool:
        """Whether a program's block of that size in bytes, with or without its padding, is of these members."""
        return self.size == declared + -declared % ALIGNMENT

    def write(self, value: Kind) -> None:
        """Replaces the value."""
        data = value.packed()
        if data != self._data:
            self._buffer.write(data)
        self.value, self._data = value, data

    def binds(self, place: int) -> Callable[[], None]:
        """Returns what binds the buffer to a binding point."""
        mglo: Any = self._buffer.mglo
        return partial(mglo.bind_to_uniform_block, place, 0, -1)  # all of it

    def release(self) -> None:
        """Frees the buffer."""
        self._buffer.release()
        self.mglo = self._buffer.mglo
