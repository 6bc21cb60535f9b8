"""Threads of a node: one reads a camera into a slot, one tracks the render server's clock."""

import queue
import threading
import time
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from deltalight.protocol.clock import Clock, ClockEstimator, clock_exchange, measure_offset
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.keys import Keys
from deltalight.protocol.request import RequestClient
from deltalight.sensor_node.cameras.base import Camera, EndOfStream

POLL_S = 0.1
CLOCK_PERIOD_S = 2.0
CLOCK_TIMEOUT_S = 0.5
CLOCK_ROUNDS = 4
# Against the monotonic clock, between two checks: less than a frame, more than slewing (500 ppm) in 30 s.
CLOCK_JUMP_NS = 15_000_000
REMARK_S = 10.0


@dataclass(frozen=True)
class CapturedFrame:
    """A frame and its capture time, in ns since 1970 by this host's clock."""

    frame: SensorFrame
    capture_ns: int


class CaptureThread:
    """Reads an open camera into one slot: a newer frame replaces one that nobody took, and `drops` counts it.

    With `keep_all` the camera waits instead. `error` is the exception that ended capture, except the camera's end or
    `close`.
    """

    def __init__(self, camera: Camera, *, keep_all: bool) -> None:
        self.drops = 0
        self.error: Exception | None = None
        self._camera, self._keep_all = camera, keep_all
        self._slot: queue.Queue[CapturedFrame] = queue.Queue(maxsize=1)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)

    def __enter__(self) -> Self:
        """Starts reading."""
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stops reading."""
        self._closing.set()
        self._camera.interrupt()
        self._thread.join()

    @property
    def ended(self) -> bool:
        """Whether no further frame will come."""
        return not self._thread.is_alive() and self._slot.empty()

    def take(self, timeout_s: float) -> CapturedFrame | None:
        """Takes the newest frame; None if there is none in time."""
        try:
            return self._slot.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def _run(self) -> None:
        try:
            while not self._closing.is_set():
                frame = self._camera.read()
                self._put(CapturedFrame(frame, self._camera.capture_ns))
        except EndOfStream:
            pass
        except Exception as error:  # raised by whoever waits for frames
            self.error = error

    def _put(self, captured: CapturedFrame) -> None:
        while not self._closing.is_set():
            try:
                self._slot.put(captured, block=self._keep_all, timeout=POLL_S)
                return
            except queue.Full:
                if not self._keep_all and self.take(0) is not None:
                    self.drops += 1


class ServerClock:
    """Tracks the clock of a render server in a thread; does nothing without an endpoint.

    It detects when a clock is set: this host's at the next `at`, the server's at the next comparison. Earlier
    measurements are then discarded.

    Args:
        node: name that the requests carry.
        endpoint: control endpoint of the server.
        keys: required if the endpoint leaves the host.
        now: this host's clock, ns since 1970.
    """

    def __init__(
        self, node: str, endpoint: str | None, *, keys: Keys | None = None, now: Clock = time.time_ns
    ) -> None:
        self._estimator = ClockEstimator()
        self._now, self._wall_ns = now, now() - time.monotonic_ns()
        self._remark, self._remark_until_s = "", 0.0
        self._lock, self._closing, self._is_due = threading.Lock(), threading.Event(), threading.Event()
        self._client = None if endpoint is None else RequestClient(endpoint, keys=keys)
        self._thread = threading.Thread(target=self._run, args=(node,), name="clock", daemon=True)
        self._thread.start()

    def at(self, local_ns: int) -> tuple[int, int | None]:
        """Returns the offset to the server's clock and its bound in ns; 0 and None if never compared."""
        with self._lock:
            self._check_own_clock()
            sample = self._estimator.at(local_ns)
        return (0, None) if sample is None else (sample.offset_ns, sample.bound_ns)

    @property
    def remark(self) -> str:
        """Returns a sentence about a clock that was set recently, else nothing."""
        with self._lock:
            return self._remark if time.monotonic() < self._remark_until_s else ""

    def close(self) -> None:
        """Stops the thread."""
        self._closing.set()
        self._is_due.set()
        self._thread.join()
        if self._client is not None:
            self._client.close()

    def _check_own_clock(self) -> bool:
        """Whether this host's clock was set since the last check, which invalidates earlier measurements."""
        wall_ns = self._now() - time.monotonic_ns()
        jump_ns, self._wall_ns = wall_ns - self._wall_ns, wall_ns
        if abs(jump_ns) < CLOCK_JUMP_NS or self._client is None:
            return False
        self._estimator.forget()
        self._note_clock_set("this host's", jump_ns)
        self._is_due.set()
        return True

    def _note_clock_set(self, whose: str, jump_ns: int) -> None:
        self._remark = f"{whose} clock was set by {jump_ns / 1e9:+.3g} s and the clocks are compared again"
        self._remark_until_s = time.monotonic() + REMARK_S

    def _run(self, node: str) -> None:
        if self._client is None:
            return
        exchange = clock_exchange(self._client.request, node, CLOCK_TIMEOUT_S)
        while True:
            self._is_due.clear()
            if self._closing.is_set():
                return
            try:
                sample = measure_offset(exchange, CLOCK_ROUNDS, self._now)
            except DeltalightError:  # no server yet; meanwhile the bound of earlier measurements grows
                self._closing.wait(POLL_S)
                continue
            with self._lock:
                if self._check_own_clock():
                    continue
                jump_ns = self._estimator.add(sample)
                if jump_ns:
                    self._note_clock_set("the server's", jump_ns)
            self._is_due.wait(CLOCK_PERIOD_S)
