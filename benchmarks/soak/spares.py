"""When the spares of a soaked station are ready to take the place of their processes."""

import time
from collections import deque
from dataclasses import dataclass, field

from deltalight.benchmarks.soak.samples import processor_time_s
from deltalight.benchmarks.soak.station import Station

QUIET_S = 10.0  # longer than the server's spare waits for a calm document, and than it rests
QUIET_LOAD = 0.05  # of a core
POLL_S = 0.5


@dataclass
class _Spare:
    """What a spare used of the processor lately: moments of the monotonic clock, and seconds."""

    process_id: int
    used: deque[tuple[float, float]] = field(default_factory=deque)

    def is_quiet(self, now_s: float) -> bool:
        """Looks at it, and returns whether it has been quiet for long enough."""
        self.used.append((now_s, processor_time_s(self.process_id)))
        while len(self.used) > 1 and self.used[1][0] <= now_s - QUIET_S:
            self.used.popleft()
        (since_s, before_s), (_, after_s) = self.used[0], self.used[-1]
        return now_s - since_s >= QUIET_S and after_s - before_s < QUIET_LOAD * (now_s - since_s)


def wait_for_spare(station: Station, name: str, patience_s: float) -> float | None:
    """Waits until the spare of a process has nothing left to prepare; returns the seconds until then.

    It has not while it uses the processor. None once so much time is up without.
    """
    began_s, spare = time.monotonic(), _Spare(0)
    while (now_s := time.monotonic()) < began_s + patience_s:
        station.check()
        process_id = station.spare_id(name)
        if process_id is not None and process_id != spare.process_id:
            spare = _Spare(process_id)
        try:
            if process_id is not None and spare.is_quiet(now_s):
                return now_s - QUIET_S - began_s
        except OSError:  # it died, or has taken over
            spare = _Spare(0)
        time.sleep(POLL_S)
    return None
