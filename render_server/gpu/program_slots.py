"""Slots of a linked program: its active resources by name, each with its unit or binding point."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any
from weakref import ReferenceType, ref

import numpy as np

SETS_KEPT = 32  # sets of resources whose calls a program keeps: some for each camera of a room
Value = float | int | bool | Sequence[float] | Sequence[Sequence[float]] | np.ndarray[Any, Any]
Calls = Sequence[Callable[[], None]]


@dataclass(eq=False)
class Slot:
    """An active resource of a linked program with its unit or binding point; `last` is what a uniform holds."""

    name: str
    member: Any
    kind: int = 0
    place: int = 0
    last: bytes | Value | None = None


class BindingCalls:
    """The calls that bind the resources of a program, for each set of them that it ran with while all of it lives.

    What was bound once needs no more checks, and most runs bind what the same run of the last frame did.
    """

    def __init__(self) -> None:
        self._kept: dict[tuple[int, ...], tuple[Calls, list[ReferenceType[Any]]]] = {}

    def of(self, items: Sequence[object]) -> Calls | None:
        """Returns the calls that bind these very objects, None if there are none yet."""
        found = self._kept.get(tuple(map(id, items)))
        return None if found is None else found[0]

    def keep(self, items: Sequence[object], calls: Calls) -> None:
        """Keeps the calls that bind `items` (None: nothing), until one of these ends: its id may be used again."""
        if len(self._kept) >= SETS_KEPT:
            self._kept.clear()
        kept, ids = self._kept, tuple(map(id, items))

        def forget(_: object) -> None:
            kept.pop(ids, None)

        kept[ids] = calls, [ref(item, forget) for item in items if item is not None]


def values_of(names: Sequence[str]) -> Callable[[Mapping[str, Any]], tuple[Any, ...]]:
    """Returns what looks up the values of `names` (KeyError if one is missing)."""
    if len(names) > 1:
        return itemgetter(*names)
    return lambda known: tuple([known[name] for name in names])
