"""Work of a step on all cores: a driver compiles on one, and a process has one context."""

import os
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import get_context
from typing import TYPE_CHECKING, Generic, TypeVar

from deltalight.benchmarks.gpu_check.record import fault_sentence

if TYPE_CHECKING:
    from deltalight.render_server.gpu.context import GpuContext

MOST_PROCESSES = 16  # each takes up to a gigabyte

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class Done(Generic[Item, Result]):
    """What became of an item: its result, or a sentence that says what went wrong."""

    item: Item
    result: Result | None
    fault: str | None


def usable_cores() -> int:
    """Returns on how many cores this process may run, and at most MOST_PROCESSES."""
    return min(len(os.sched_getaffinity(0)), MOST_PROCESSES)


@contextmanager
def opened_context() -> "Iterator[GpuContext]":
    """Opens an OpenGL context, and releases it."""
    from deltalight.render_server.gpu.context import create_context

    gpu = create_context()
    try:
        yield gpu
    finally:
        gpu.release()


@cache
def process_context() -> "GpuContext":
    """Returns the context of this process, which ends with it."""
    from deltalight.render_server.gpu.context import create_context

    return create_context()


def spread(
    work: Callable[[Item], Result], items: Sequence[Item], processes: int
) -> Iterator[Done[Item, Result]]:
    """Does the work on every item, in processes of its own, and returns each as soon as it is done.

    `work` is a function of a module, or a partial of one. A driver that ends a process ends the whole work: what was
    not done by then is at fault.
    """
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        futures = {pool.submit(partial(guarded, work), item): item for item in items}
        for future in as_completed(futures):
            yield Done(futures[future], *_outcome(future))


def guarded(work: Callable[[Item], Result], item: Item) -> tuple[Result | None, str | None]:
    """Does the work; returns its result, or a sentence that says what was raised, whose traceback is printed."""
    try:
        return work(item), None
    except Exception as fault:
        traceback.print_exc()
        return None, fault_sentence(fault)


def _outcome(
    future: "Future[tuple[Result | None, str | None]]",
) -> tuple[Result | None, str | None]:
    fault = future.exception()
    return future.result() if fault is None else (None, f"{type(fault).__name__}, {fault}")
