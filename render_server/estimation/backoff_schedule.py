"""Exponential back-off for re-measurement."""

FIRST_WAIT_S = 1.0
MAX_WAIT_S = 30.0


class BackoffSchedule:
    """Due immediately, then after intervals that double from 1 to 30 s of the frames' own time.

    An average over time converges soon; keeping it up to date then costs almost nothing.
    """

    def __init__(self) -> None:
        self._last_ns: int | None = None
        self._wait_s = FIRST_WAIT_S

    def is_due(self, timestamp_ns: int) -> bool:
        """Whether a measurement is due; if so, starts the next interval. Restarts if the clock is set back."""
        if self._last_ns is None:
            self._last_ns = timestamp_ns
            return True
        self._last_ns = min(self._last_ns, timestamp_ns)
        if timestamp_ns - self._last_ns < self._wait_s * 1e9:
            return False
        self._last_ns, self._wait_s = timestamp_ns, min(2 * self._wait_s, MAX_WAIT_S)
        return True
