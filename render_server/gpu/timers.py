"""Times per pass: GPU timer queries, or finish + clock where the driver's queries read zero (llvmpipe)."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import moderngl

from deltalight.render_server.gpu.context import GpuContext

QUERIES_IN_FLIGHT = 3  # frames until a query is read without waiting for the GPU


class PassTimers:
    """Milliseconds per pass, by name, for the newest frame with known times.

    A pass that runs several times in a frame is summed.
    """

    def __init__(self, gpu: GpuContext) -> None:
        self._gpu = gpu
        self._free: list[moderngl.Query] = []
        self._pending: list[list[tuple[str, moderngl.Query]]] = []
        self._current: list[tuple[str, moderngl.Query]] = []
        self._clock: dict[str, float] = {}
        self.times_ms: dict[str, float] = {}
        self.last_ms: dict[str, float] = {}  # of each pass when it last ran

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Times the GL work issued inside."""
        if self._gpu.is_software:
            start = time.perf_counter()
            yield
            self._gpu.ctx.finish()
            elapsed = (time.perf_counter() - start) * 1e3
            self._clock[name] = self._clock.get(name, 0.0) + elapsed
            return
        query = self._free.pop() if self._free else self._gpu.ctx.query(time=True)
        with query:
            yield
        self._current.append((name, query))

    def end_frame(self) -> dict[str, float]:
        """Ends the frame and returns the newest known times."""
        if self._gpu.is_software:
            self.times_ms, self._clock = self._clock, {}
            self.last_ms |= self.times_ms
            return self.times_ms
        self._pending.append(self._current)
        self._current = []
        if len(self._pending) >= QUERIES_IN_FLIGHT:
            self.times_ms = self._read(self._pending.pop(0))
        return self.times_ms

    def _read(self, queries: list[tuple[str, moderngl.Query]]) -> dict[str, float]:
        """Sums the queries of one frame by name and frees them."""
        times: dict[str, float] = {}
        for name, query in queries:
            times[name] = times.get(name, 0.0) + query.elapsed / 1e6
            self._free.append(query)
        self.last_ms |= times
        return times

    def wait(self) -> None:
        """Waits for the GPU, so that the times of all frames are known."""
        while self._pending:
            self.times_ms = self._read(self._pending.pop(0))
