"""How many requests a client may send: a token bucket for each address."""

import time
from collections import OrderedDict
from collections.abc import Callable

REMEMBERED_CLIENTS = 4096


class RateLimit:
    """Lets `per_s` requests a second through for long and `burst` at once, for each client (one thread)."""

    def __init__(self, per_s: float, burst: float, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._per_s = per_s
        self._burst = burst
        self._clock_s = clock_s
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def wait_s(self, client: str) -> float:
        """Seconds until this client may send its next request, 0 where it may now."""
        left, _ = self._level(client)
        return 0.0 if left >= 1 else (1 - left) / self._per_s

    def take(self, client: str) -> None:
        """Count a request of this client."""
        left, now_s = self._level(client)
        self._buckets[client] = left - 1, now_s
        self._buckets.move_to_end(client)
        if len(self._buckets) > REMEMBERED_CLIENTS:
            self._buckets.popitem(last=False)

    def _level(self, client: str) -> tuple[float, float]:
        now_s = self._clock_s()
        left, then_s = self._buckets.get(client, (self._burst, now_s))
        return min(self._burst, left + (now_s - then_s) * self._per_s), now_s
