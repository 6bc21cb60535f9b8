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

    What was bound once needs no more checks, and most runs bind what the same run of the last frame did. `binders`
    check a resource each and return the call that binds it.
    """

    def __init__(self, binders: Sequence[Callable[[Any], Callable[[], None]]]) -> None:
        self._binders = binders
        self._kept: dict[tuple[int, ...], tuple[Calls, list[ReferenceType[Any]]]] = {}

    def of(self, items: Sequence[Any]) -> Calls:
        """Returns the calls that bind these very objects; None among them stands for nothing."""
        found = self._kept.get(tuple(map(id, items)))
        if found is not None:
            return found[0]
        calls = [binder(item) for binder, item in zip(self._binders, items, strict=True)]
        self._keep(items, calls)
        return calls

    def _keep(self, items: Sequence[Any], calls: Calls) -> None:
        """Keeps the calls until one of the items ends: its id may be used again."""
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
