"""Slots of a linked program: its active resources by name, each with its unit or binding point."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any
from weakref import ref

import numpy as np

FITTING_KEPT = 32  # textures of a name that need not be checked again: some for each camera of a room
Value = float | int | bool | Sequence[float] | Sequence[Sequence[float]] | np.ndarray[Any, Any]


def _nothing() -> None:
    """Stands where no texture was checked yet."""


@dataclass(eq=False)
class Slot:
    """An active resource of a linked program with its unit or binding point.

    `checked` returns the texture that was bound last, `fitting` those that were found to fit, by their ids, while
    they live; `last` is what a uniform holds.
    """

    name: str
    member: Any
    kind: int = 0
    place: int = 0
    checked: Callable[[], object] = _nothing
    fitting: dict[int, Callable[[], object]] = field(default_factory=dict)
    last: bytes | Value | None = None

    def is_known(self, texture: object) -> bool:
        """Returns whether this very texture was found to fit before: cameras of a room take turns in each frame."""
        self.checked = self.fitting.get(id(texture), _nothing)
        return self.checked() is texture

    def note_fitting(self, texture: object) -> None:
        """Notes that a texture fits."""
        if len(self.fitting) >= FITTING_KEPT:
            self.fitting.clear()
        self.checked = self.fitting[id(texture)] = ref(texture)
