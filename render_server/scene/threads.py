"""Work on other threads, for NumPy and OpenCV: both release the interpreter lock while they compute."""

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

Result = TypeVar("Result")

# Threads wait for that lock around each call of NumPy: with smaller bands, two are no faster than one.
LEAST_BAND_ROWS = 320


def submit(call: Callable[[], Result]) -> "Future[Result]":
    """Starts a call on another thread."""
    return _threads().submit(call)


def by_bands(work: Callable[[slice], None], rows: int) -> None:
    """Calls `work` with each band of a picture's rows, on this thread and on others that are free.

    Raises:
        Exception: what `work` raises.
    """
    bands = max(min(rows // LEAST_BAND_ROWS, _cores()), 1)
    ends = [rows * number // bands for number in range(bands + 1)]
    pending = iter(list(map(slice, ends[:-1], ends[1:])))

    def work_on() -> None:
        for part in pending:
            work(part)

    helpers = [submit(work_on) for _ in range(bands - 1)]
    work_on()
    for each in helpers:
        if not each.cancel():
            each.result()


def _cores() -> int:
    return os.cpu_count() or 1


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_cores(), "scene")
