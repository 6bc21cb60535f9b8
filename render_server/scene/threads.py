"""Work on all cores: NumPy and OpenCV let other threads run while they compute."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

Result = TypeVar("Result")
Part = TypeVar("Part")

# Of a picture: few enough to stay in a core's cache, so many that threads seldom wait for each other.
BAND_ROWS = 120
MIN_BAND_ROWS = 24  # where cores would be idle otherwise


def begun(call: Callable[[], Result]) -> "Future[Result]":
    """Begins a call on another thread."""
    return _threads().submit(call)


def by_bands(work: Callable[[slice], None], rows: int) -> None:
    """Calls `work` with each band of a picture's rows, on this thread and on others that are free.

    Raises:
        Exception: what `work` raises.
    """
    step = min(BAND_ROWS, max(-(-rows // _cores()), MIN_BAND_ROWS))
    for_each(work, [slice(first, min(first + step, rows)) for first in range(0, rows, step)])


def for_each(work: Callable[[Part], None], parts: Sequence[Part]) -> None:
    """Calls `work` with each part, on this thread and on others that are free.

    Raises:
        Exception: what `work` raises.
    """
    pending = iter(parts)

    def work_on() -> None:
        for part in pending:
            work(part)

    helpers = [begun(work_on) for _ in range(min(_cores(), len(parts)) - 1)]
    work_on()
    for each in helpers:
        if not each.cancel():
            each.result()


def _cores() -> int:
    return os.cpu_count() or 1


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_cores(), "scene")
