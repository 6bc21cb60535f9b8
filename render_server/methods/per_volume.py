"""Stages that run for each of several volumes, one after the other."""

from collections.abc import Callable
from functools import update_wrapper
from typing import Any, Generic, TypeVar, cast

from deltalight.render_server.gpu.textures import Releasable, release_all
from deltalight.render_server.graph import Graph

T = TypeVar("T")
Item = TypeVar("Item", bound=Releasable)


class PerVolume(tuple[T, ...]):
    """A value for each volume."""

    __slots__ = ()


class Several(Generic[Item]):
    """As many items as there are volumes: made when more are wanted, freed when fewer are."""

    def __init__(self, make: Callable[[], Item]) -> None:
        self._make, self._made = make, [make()]

    def of(self, count: int) -> list[Item]:
        """Returns `count` items."""
        self._made += [self._make() for _ in range(count - len(self._made))]
        release_all(*self._made[count:])
        del self._made[count:]
        return self._made

    def release(self) -> None:
        """Frees them all."""
        release_all(*self._made)


class OfEach(Generic[Item, T]):
    """A stage that calls a method of each item. Of inputs for each volume, everyone gets its own.

    Of a method that returns several `outputs`, it returns each for all volumes.
    """

    def __init__(self, items: Several[Item], method: Callable[..., T], *, outputs: int = 1) -> None:
        self._items, self._method, self._outputs = items, method, outputs
        update_wrapper(self, method)  # reports of the graph tell what it does

    def __call__(self, *inputs: Any) -> PerVolume[T] | tuple[PerVolume[Any], ...]:  # noqa: ANN401 (a stage's)
        """Returns what the method returns for each volume."""
        count = next(len(each) for each in inputs if isinstance(each, PerVolume))
        found = [
            self._method(item, *(each[index] if isinstance(each, PerVolume) else each for each in inputs))
            for index, item in enumerate(self._items.of(count))
        ]
        if self._outputs == 1:
            return PerVolume(found)
        return tuple(PerVolume(each) for each in zip(*cast(Any, found), strict=True))

    def __eq__(self, other: object) -> bool:
        """Whether both do the same: views share such stages."""
        return isinstance(other, OfEach) and self._items is other._items and self._method == other._method

    def __hash__(self) -> int:
        """Returns a hash of what both are told apart by."""
        return hash((id(self._items), self._method))


def several(g: Graph, name: str, make: Callable[[], Item]) -> Several[Item]:
    """Returns what the graph's volumes share, which it frees with itself."""
    made = g.shared(name, lambda: Several(make))
    g.own(made)
    return made
