"""Limits per client: requests per second, and long-lived connections."""

import asyncio
import time
from collections import Counter, OrderedDict
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager

from deltalight.services.api.memory_return import MemoryReturn
from deltalight.services.api.problems import ProblemError

REMEMBERED_CLIENTS = 4096
# Behind an SSH tunnel or a proxy all users of a house are one client; four dashboards of one user need eight.
STREAMS_PER_CLIENT = 64
MAX_STREAMS = 192  # three quarters of all connections, so that requests still get through
CHECK_INTERVAL_S = 5.0


class RateLimit:
    """A token bucket per client: `per_s` requests per second sustained, `burst` at once (one thread)."""

    def __init__(self, per_s: float, burst: float, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._per_s = per_s
        self._burst = burst
        self._clock_s = clock_s
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, client: str) -> float:
        """Returns the seconds until this client may send its next request, 0 if it may now."""
        left, _ = self._level(client)
        return 0.0 if left >= 1 else (1 - left) / self._per_s

    def take(self, client: str) -> None:
        """Counts a request of this client."""
        left, now_s = self._level(client)
        self._buckets[client] = left - 1, now_s
        self._buckets.move_to_end(client)
        if len(self._buckets) > REMEMBERED_CLIENTS:
            self._buckets.popitem(last=False)

    def _level(self, client: str) -> tuple[float, float]:
        now_s = self._clock_s()
        left, then_s = self._buckets.get(client, (self._burst, now_s))
        return min(self._burst, left + (now_s - then_s) * self._per_s), now_s


class StreamLimits:
    """Limits the open streams of each client and of all together (one event loop)."""

    def __init__(self) -> None:
        self._open: Counter[str] = Counter()
        self._memory = MemoryReturn()

    @contextmanager
    def slot(self, client: str) -> Iterator[None]:
        """Occupies one of the client's streams for the duration of the block.

        Raises:
            ProblemError: this client has too many streams, or all clients together have.
        """
        if self._open[client] >= STREAMS_PER_CLIENT:
            raise _full("This client has too many live connections; close some.")
        if self._open.total() >= MAX_STREAMS:
            raise _full("There are too many live connections; close some or come again later.")
        self._open[client] += 1
        try:
            yield
        finally:
            self._open[client] -= 1
            if not self._open[client]:
                del self._open[client]
            self._memory.note_ended()


async def run_while(stream: Awaitable[None], is_allowed: Callable[[], Awaitable[bool]]) -> bool:
    """Runs a stream and returns whether it ended by itself; cancels it soon after it is no longer allowed."""
    running = asyncio.ensure_future(stream)
    try:
        while not (await asyncio.wait({running}, timeout=CHECK_INTERVAL_S))[0]:
            if not await is_allowed():
                return False
        running.result()
        return True
    finally:
        running.cancel()


def _full(sentence: str) -> ProblemError:
    return ProblemError(429, "too-many-streams", sentence, {"Retry-After": "5"})
