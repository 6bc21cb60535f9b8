"""Offset between the clocks of two hosts, with a guaranteed bound (SPEC.md, section 7).

One exchange gives four stamps as in NTP (RFC 5905, section 8): t0 request sent and t3 reply received by the local
clock, t1 request received and t2 reply sent by the remote one. Whatever the two delays are, the true offset lies
within half the round trip of the midpoint; so the exchange with the shortest round trip is best.
"""

import time
import uuid
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import ControlReply, ControlRequest

CLOCK_OP = "clock"
MAX_DRIFT_PPM = 200.0  # twice that of a bad crystal
WINDOW = 64
LATEST_NS = 2**62  # in the year 2116; messages hold no greater offset (SPEC.md, section 3)

Clock = Callable[[], int]
Exchange = Callable[[], tuple[int, int]]


@dataclass(frozen=True)
class ClockSample:
    """Result of one exchange, nanoseconds.

    local + offset_ns = remote, with an error of at most bound_ns; measured_ns is the local time of the measurement.
    """

    offset_ns: int
    bound_ns: int
    measured_ns: int


def sample_from_stamps(t0: int, t1: int, t2: int, t3: int) -> ClockSample:
    """Computes offset and bound of one exchange from its four stamps in nanoseconds (see the module).

    Raises:
        DeltalightError: the stamps run backwards, because a clock was set meanwhile.
    """
    round_trip = (t3 - t0) - (t2 - t1)
    if t3 < t0 or t2 < t1 or round_trip < 0:
        raise DeltalightError("a clock was set while it was compared; compare again.")
    # Halves are rounded up, so that the bound still holds.
    return ClockSample(((t1 - t0) + (t2 - t3)) // 2, (round_trip + 1) // 2 + 1, t3)


def measure_offset(exchange: Exchange, rounds: int = 8, now: Clock = time.time_ns) -> ClockSample:
    """Returns the best of several exchanges: the one with the shortest round trip.

    `exchange()` asks the remote side and returns its stamps (t1, t2).

    Raises:
        DeltalightError: no exchange gave usable stamps.
    """
    samples = []
    for _ in range(rounds):
        t0 = now()
        t1, t2 = exchange()
        try:
            samples.append(sample_from_stamps(t0, t1, t2, now()))
        except DeltalightError:
            continue
    if not samples:
        raise DeltalightError(
            "the clocks jumped in every exchange; see whether something sets them all the time."
        )
    return min(samples, key=lambda sample: sample.bound_ns)


class ClockEstimator:
    """Offset that stays valid over time: that of the sample whose bound, widened by drift, is smallest."""

    def __init__(self, max_drift_ppm: float = MAX_DRIFT_PPM, window: int = WINDOW) -> None:
        self._drift = max_drift_ppm * 1e-6
        self._samples: deque[ClockSample] = deque(maxlen=window)

    def add(self, sample: ClockSample) -> int:
        """Adds a measurement; returns by how much a clock was set meanwhile, ns, 0 = not at all.

        A measurement that contradicts earlier ones (a clock was set) discards them.
        """
        jump_ns = 0
        if any(
            abs(old.offset_ns - sample.offset_ns) > self._contradiction(old, sample) for old in self._samples
        ):
            jump_ns = sample.offset_ns - self._samples[-1].offset_ns
            self._samples.clear()
        self._samples.append(sample)
        return jump_ns

    def forget(self) -> None:
        """Discards all measurements, because a clock was set."""
        self._samples.clear()

    def at(self, local_ns: int) -> ClockSample | None:
        """Returns offset and bound at a local time, None before the first measurement."""
        if not self._samples:
            return None
        best = min(self._samples, key=lambda sample: self._grown(sample, local_ns))
        return ClockSample(best.offset_ns, self._grown(best, local_ns), best.measured_ns)

    def _grown(self, sample: ClockSample, local_ns: int) -> int:
        return sample.bound_ns + round(abs(local_ns - sample.measured_ns) * self._drift)

    def _contradiction(self, old: ClockSample, new: ClockSample) -> int:
        return self._grown(old, new.measured_ns) + new.bound_ns


def clock_payload(received_ns: int, now: Clock = time.time_ns) -> dict[str, object]:
    """Returns the payload of a reply to the op `clock`: when the request arrived, and now."""
    return {"received_ns": received_ns, "sent_ns": now()}


def clock_exchange(
    request: Callable[[ControlRequest, float], ControlReply], node: str, timeout_s: float = 1.0
) -> Exchange:
    """Returns an exchange by control requests, for `measure_offset`; `request` is `RequestClient.request`.

    The exchange raises DeltalightError if the server does not answer or does not know the op.
    """

    def exchange() -> tuple[int, int]:
        question = ControlRequest(node=node, id=uuid.uuid4().hex, op=CLOCK_OP)
        reply = request(question, timeout_s)
        t1, t2 = reply.payload.get("received_ns"), reply.payload.get("sent_ns")
        if not isinstance(t1, int) or not isinstance(t2, int):
            raise DeltalightError(f"the server does not report its time ({reply.error}); update it.")
        if not (0 <= t1 <= LATEST_NS and 0 <= t2 <= LATEST_NS):
            raise DeltalightError("the server's clock is centuries off; set it.")
        return t1, t2

    return exchange
