"""Stages that run once for each of a scene's volumes, one after the other."""

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


class VolumePool(Generic[Item]):
    """An item for each volume, such as its buffers: made when volumes are added, freed when they are removed."""

    def __init__(self, make: Callable[[], Item]) -> None:
        self._make, self._items = make, [make()]

    def resized(self, count: int) -> list[Item]:
        """Returns `count` items."""
        self._items += [self._make() for _ in range(count - len(self._items))]
        release_all(*self._items[count:])
        del self._items[count:]
        return self._items

    def release(self) -> None:
        """Frees all items."""
        release_all(*self._items)


class ForEachVolume(Generic[Item, T]):
    """A stage's function that calls a method of every item in a pool.

    Each item gets its own volume's value of inputs that are `PerVolume`, and all other inputs as they are. A method
    with several `outputs` returns them as a tuple; the stage then returns a `PerVolume` for each output.
    """

    def __init__(self, pool: VolumePool[Item], method: Callable[..., T], *, outputs: int = 1) -> None:
        self._pool, self._method, self._outputs = pool, method, outputs
        update_wrapper(self, method)  # reports of the graph quote the method's docstring

    def __call__(self, *inputs: Any) -> PerVolume[T] | tuple[PerVolume[Any], ...]:  # noqa: ANN401 (a stage's)
        """Returns what the method returns for each volume."""
        count = next(len(value) for value in inputs if isinstance(value, PerVolume))
        results = [
            self._method(item, *(value[index] if isinstance(value, PerVolume) else value for value in inputs))
            for index, item in enumerate(self._pool.resized(count))
        ]
        if self._outputs == 1:
            return PerVolume(results)
        return tuple(PerVolume(output) for output in zip(*cast(Any, results), strict=True))

    def __eq__(self, other: object) -> bool:
        """Whether both call the same method of the same pool: views share such stages."""
        return (
            isinstance(other, ForEachVolume) and self._pool is other._pool and self._method == other._method
        )

    def __hash__(self) -> int:
        """Returns a hash of the pool and the method."""
        return hash((id(self._pool), self._method))


def volume_pool(g: Graph, name: str, make: Callable[[], Item]) -> VolumePool[Item]:
    """Returns the pool of this name, which all views of the graph share and which the graph frees."""
    pool = g.shared(name, lambda: VolumePool(make))
    g.own(pool)
    return pool
