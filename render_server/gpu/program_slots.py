"""Slots of a linked program: its active resources by name, each with its unit or binding point."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, Final

import moderngl
import numpy as np

SETS_KEPT = 32  # sets of resources whose calls a program keeps: some for each camera of a room
Value = float | int | bool | np.generic | Sequence[float] | Sequence[Sequence[float]] | np.ndarray[Any, Any]
Calls = Sequence[Callable[[], None]]

# The `kind` of slots, by OpenGL's number.
SAMPLERS: Final = {  # of textures, and what their texels are read as: float, signed or unsigned
    0x8B5E: (moderngl.Texture, "f"),  # sampler2D
    0x8DCA: (moderngl.Texture, "i"),  # isampler2D
    0x8DD2: (moderngl.Texture, "u"),  # usampler2D
    0x8B5F: (moderngl.Texture3D, "f"),  # sampler3D
    0x8DC1: (moderngl.TextureArray, "f"),  # sampler2DArray
    0x8DD3: (moderngl.Texture3D, "u"),  # usampler3D
}
IMAGES: Final = {
    0x904D: moderngl.Texture,  # image2D
    0x9058: moderngl.Texture,  # iimage2D
    0x9063: moderngl.Texture,  # uimage2D
    0x904E: moderngl.Texture3D,  # image3D
    0x9064: moderngl.Texture3D,  # uimage3D
    0x9053: moderngl.TextureArray,  # image2DArray
}


@dataclass(eq=False, slots=True)
class Slot:
    """An active resource of a linked program with its unit or binding point; `last` is what a uniform holds."""

    name: str
    member: Any
    kind: int = 0
    place: int = 0
    last: bytes | Value | None = None


class BindingCalls:
    """The calls that bind the resources of a program, for each set of them that it ran with lately.

    What was bound once needs no more checks, and most runs bind what the same run of the last frame did. `binders`
    check a resource each and return the call that binds it.
    """

    def __init__(self, binders: Sequence[Callable[[Any], Callable[[], None]]]) -> None:
        self._binders = binders
        self._kept: dict[tuple[object, ...], Calls] = {}

    def of(self, items: Sequence[Any]) -> Calls:
        """Returns the calls that bind these very objects; None among them stands for nothing.

        Sets are told apart by what moderngl holds of OpenGL's objects (`mglo`): of a released one that is another
        object, so that calls with its name, which may be another's by now, are never found.
        """
        try:
            held = tuple([None if item is None else item.mglo for item in items])
        except AttributeError:  # what has none cannot be bound, as its binder says
            return self._made(items)
        calls = self._kept.get(held)
        if calls is None:
            calls = self._made(items)
            if len(self._kept) >= SETS_KEPT:
                self._kept.clear()
            self._kept[held] = calls
        return calls

    def _made(self, items: Sequence[Any]) -> Calls:
        return [binder(item) for binder, item in zip(self._binders, items, strict=True)]


def values_of(names: Sequence[str]) -> Callable[[Mapping[str, Any]], tuple[Any, ...]]:
    """Returns what looks up the values of `names` (KeyError if one is missing)."""
    if len(names) > 1:
        return itemgetter(*names)
    if names:
        (only,) = names
        return lambda known: (known[only],)
    return lambda _: ()
