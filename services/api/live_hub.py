"""The newest composite, shared by any number of viewers, each at its own pace."""

import asyncio
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

from deltalight.protocol.messages import CompositeMessage
from deltalight.services.live_message import PictureHeader, ViewerHeader, age_ms, pack

RATE_WINDOW_S = 3.0
STALE_AFTER_S = 2.0


@dataclass(frozen=True)
class LiveFrame:
    """A composite for viewers; `number` counts the frames that arrived, `header` is a `PictureHeader` as JSON.

    It arrived at `arrived_s` of the monotonic clock and `arrived_ns` of this host's.
    """

    number: int
    message: CompositeMessage
    jpeg: bytes
    arrived_s: float
    arrived_ns: int
    header: bytes

    def packed(self, skipped: int) -> bytes:
        """Return the message for a viewer that was not sent `skipped` frames."""
        return pack(self.header, ViewerHeader(age_ms=age_ms(self.message), skipped=skipped), self.jpeg)


class Viewer:
    """One viewer of the stream; `skipped` counts the frames that it was not sent."""

    def __init__(self, hub: "LiveHub") -> None:
        self.skipped = 0
        self._hub = hub
        self._number = 0

    async def next(self) -> LiveFrame | None:
        """Wait for a frame newer than this viewer's last; None = the stream has ended."""
        frame = await self._hub.newer_than(self._number)
        if frame is not None:
            missed = frame.number - self._number - 1 if self._number else 0
            self.skipped += missed
            self._number = frame.number
            self._hub.note_sent(missed)
        return frame


class LiveHub:
    """Holds only the newest frame; viewers that wait for a newer one do not delay each other."""

    def __init__(self) -> None:
        self.viewers = 0
        self.sent = 0
        self.skipped = 0
        self._newest: LiveFrame | None = None
        self._arrivals_s: deque[float] = deque()
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._arrived = asyncio.Event()
        self._ended = False

    def attach(self, loop: asyncio.AbstractEventLoop) -> None:
        """Wake viewers in this event loop from now on."""
        self._loop = loop

    def publish(self, message: CompositeMessage, jpeg: bytes, renderer: str) -> None:
        """Publish a composite as the newest, and wake all waiting viewers (any thread).

        Raises:
            DeltalightError: its header is invalid.
        """
        now_s = time.monotonic()
        with self._lock:
            self._arrivals_s.append(now_s)
            number = 1 if self._newest is None else self._newest.number + 1
            header = PictureHeader.of(message, number=number, frames_per_s=self._rate(), renderer=renderer)
            encoded = header.model_dump_json().encode()
            self._newest = LiveFrame(number, message, jpeg, now_s, time.time_ns(), encoded)
        self._wake_soon()

    def close(self) -> None:
        """End the stream of every viewer (any thread)."""
        self._ended = True
        self._wake_soon()

    @contextmanager
    def viewer(self) -> Iterator[Viewer]:
        """Join the stream for the duration of the block (in the event loop)."""
        self.viewers += 1
        try:
            yield Viewer(self)
        finally:
            self.viewers -= 1

    @property
    def received(self) -> int:
        """The number of frames that arrived."""
        return 0 if self._newest is None else self._newest.number

    @property
    def newest(self) -> LiveFrame | None:
        """The newest frame, if any arrived."""
        return self._newest

    async def newer_than(self, number: int) -> LiveFrame | None:
        """Wait for a frame after `number`; None = the stream has ended."""
        while not self._ended:
            arrived = self._arrived
            if self._newest is not None and self._newest.number > number:
                return self._newest
            await arrived.wait()
        return None

    def note_sent(self, missed: int) -> None:
        """Count a frame that a viewer takes, and those that it missed since its last one."""
        self.sent += 1
        self.skipped += missed

    def state(self) -> tuple[Literal["waiting", "ok", "stale"], float | None]:
        """Return whether frames arrive, and the seconds since the newest did."""
        if self._newest is None:
            return "waiting", None
        since_s = time.monotonic() - self._newest.arrived_s
        return ("ok" if since_s < STALE_AFTER_S else "stale"), since_s

    def frames_per_s(self) -> float | None:
        """Return the rate of arrival over the last seconds; None before the second frame."""
        with self._lock:
            return self._rate()

    def _rate(self) -> float | None:
        now_s = time.monotonic()
        oldest_s = now_s - RATE_WINDOW_S
        while len(self._arrivals_s) > 2 and self._arrivals_s[0] < oldest_s:
            self._arrivals_s.popleft()
        if len(self._arrivals_s) < 2:
            return None
        span_s = now_s - self._arrivals_s[0]  # up to now: the rate falls while frames stay away
        return (len(self._arrivals_s) - 1) / span_s if span_s > 0 else None

    def _wake_soon(self) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        arrived, self._arrived = self._arrived, asyncio.Event()
        arrived.set()
