"""Times per pass: GPU timer queries, or finish + clock where the driver's queries read zero (llvmpipe)."""

import time
from contextlib import AbstractContextManager
from types import TracebackType

import moderngl

from deltalight.render_server.gpu.context import GpuContext

QUERIES_IN_FLIGHT = 3  # frames until a query is read without waiting for the GPU


def has_timer_queries(gpu: GpuContext) -> bool:
    """Whether the driver's timer queries tell anything."""
    return not gpu.is_software


class PassTimers:
    """Milliseconds per pass, by name, for the newest frame with known times.

    A pass that runs several times in a frame is summed. A query runs from the moment when the GPU meets the pass's
    first command to its last one's end, so it counts what the GPU waits in between. `submit_ms` is what the CPU takes
    to issue the passes of the newest frame: a pass with about as much of either may have waited for the CPU.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._queries = has_timer_queries(gpu)
        self._pending: list[list[tuple[str, moderngl.Query]]] = []
        self._current: list[tuple[str, moderngl.Query]] = []
        self._clock: dict[str, float] = {}
        self._submitted: dict[str, float] = {}
        self.times_ms: dict[str, float] = {}
        self.submit_ms: dict[str, float] = {}
        self.last_ms: dict[str, float] = {}  # of each pass when it last ran

    def measure(self, name: str) -> AbstractContextManager[None]:
        """Times the GL work issued inside."""
        return _Queried(self, name) if self._queries else _Clocked(self, name)

    def add_clocked(self, name: str, start_s: float) -> None:
        """Waits for the GPU, and takes the time of a pass that began at `start_s`."""
        _add_since(start_s, self._submitted, name)
        self._gpu.ctx.finish()
        _add_since(start_s, self._clock, name)

    def take_query(self) -> moderngl.Query:
        """Returns a query that is not in use."""
        spare = self._gpu.spare_queries
        return spare.pop() if spare else self._gpu.ctx.query(time=True)

    def add_query(self, name: str, query: moderngl.Query, start_s: float) -> None:
        """Takes the query of a pass that began at `start_s` and has ended."""
        self._current.append((name, query))
        # Otherwise the query's end is kept back with whatever comes next, and counts the CPU's work until then.
        self._gpu.flush()
        _add_since(start_s, self._submitted, name)

    def drop_query(self, query: moderngl.Query) -> None:
        """Takes back the query of a pass that failed."""
        self._gpu.spare_queries.append(query)

    def end_frame(self) -> dict[str, float]:
        """Ends the frame and returns the newest known times."""
        self.submit_ms, self._submitted = self._submitted, {}
        if not self._queries:
            self.times_ms, self._clock = self._clock, {}
            self.last_ms |= self.times_ms
            return self.times_ms
        self._pending.append(self._current)
        self._current = []
        if len(self._pending) >= QUERIES_IN_FLIGHT:
            self.times_ms = self._read(self._pending.pop(0))
        return self.times_ms

    def _read(self, queries: list[tuple[str, moderngl.Query]]) -> dict[str, float]:
        """Sums the queries of one frame by name and gives them back."""
        times: dict[str, float] = {}
        for name, query in queries:
            times[name] = times.get(name, 0.0) + query.elapsed / 1e6
            self._gpu.spare_queries.append(query)
        self.last_ms |= times
        return times

    def wait(self) -> None:
        """Waits for the GPU, so that the times of all frames are known."""
        while self._pending:
            self.times_ms = self._read(self._pending.pop(0))

    def release(self) -> None:
        """Gives back the queries that were not read."""
        for frame in (*self._pending, self._current):
            self._gpu.spare_queries.extend(query for _, query in frame)
        self._pending, self._current = [], []


# Classes, for a frame has fifty, and generators take three times as long.
class _Clocked:
    """A pass that the CPU's clock times."""

    __slots__ = ("_name", "_start_s", "_timers")

    def __init__(self, timers: PassTimers, name: str) -> None:
        self._timers, self._name = timers, name

    def __enter__(self) -> None:
        self._start_s = time.perf_counter()

    def __exit__(
        self, fault: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        if fault is None:
            self._timers.add_clocked(self._name, self._start_s)


class _Queried:
    """A pass that a query times."""

    __slots__ = ("_name", "_query", "_start_s", "_timers")

    def __init__(self, timers: PassTimers, name: str) -> None:
        self._timers, self._name = timers, name

    def __enter__(self) -> None:
        self._start_s = time.perf_counter()
        self._query = self._timers.take_query()
        self._query.__enter__()  # type: ignore[no-untyped-call]

    def __exit__(
        self, fault: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self._query.__exit__()
        if fault is None:
            self._timers.add_query(self._name, self._query, self._start_s)
        else:
            self._timers.drop_query(self._query)


def _add_since(start_s: float, times_ms: dict[str, float], name: str) -> None:
    times_ms[name] = times_ms.get(name, 0.0) + (time.perf_counter() - start_s) * 1e3
