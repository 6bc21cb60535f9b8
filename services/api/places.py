"""Places for connections that stay open: how many a client may have, and for how long."""

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager

from services.api.problems import ProblemError

# Behind an SSH tunnel or a proxy all people of a house are one client; four dashboards of one person need eight.
PLACES_PER_CLIENT = 64
PLACES = 192  # three quarters of all connections, so that requests get through beside them
CHECK_INTERVAL_S = 5.0


class StreamPlaces:
    """Counts the open streams of each client (one event loop)."""

    def __init__(self) -> None:
        self._taken: Counter[str] = Counter()

    @contextmanager
    def taken(self, client: str) -> Iterator[None]:
        """Take a place while the block runs.

        Raises:
            ProblemError: this client has too many, or all together have.
        """
        if self._taken[client] >= PLACES_PER_CLIENT:
            raise _full("This client has too many live connections; close some.")
        if self._taken.total() >= PLACES:
            raise _full("There are too many live connections; close some or come again later.")
        self._taken[client] += 1
        try:
            yield
        finally:
            self._taken[client] -= 1
            if not self._taken[client]:
                del self._taken[client]


async def run_while(stream: Awaitable[None], is_allowed: Callable[[], Awaitable[bool]]) -> bool:
    """Run a stream to its end; whether it came there: it is cancelled soon after it is not allowed any more."""
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
