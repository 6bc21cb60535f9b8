"""The newest composite, shared by any number of viewers that each take it at their own pace."""

import asyncio
import json
import struct
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

from protocol.messages import CompositeMessage
from services.frame_age import age_ms

RATE_WINDOW_S = 3.0
STALE_AFTER_S = 2.0


@dataclass(frozen=True)
class ShownScene:
    """The scene that a picture shows, by the API's own id and revision."""

    id: str
    revision: int


@dataclass(frozen=True)
class LiveFrame:
    """A composite as viewers get it; `number` counts the frames that arrived, `facts` are JSON without its brace.

    It arrived at `arrived_s` of the monotonic clock and `arrived_ns` of this host's.
    """

    number: int
    message: CompositeMessage
    jpeg: bytes
    arrived_s: float
    arrived_ns: int
    facts: bytes

    def packed(self, skipped: int) -> bytes:
        """One binary message: little-endian uint32 length of the JSON header, the header, the JPEG.

        `skipped` and the age belong to one viewer and the moment of sending; the rest was encoded once for all.
        """
        own = json.dumps({"age_ms": age_ms(self.message), "skipped": skipped}).encode()
        header = own[:-1] + b", " + self.facts
        return struct.pack("<I", len(header)) + header + self.jpeg


class Viewer:
    """One viewer's place in the stream; `skipped` counts the frames that it was not sent."""

    def __init__(self, hub: "LiveHub") -> None:
        self.skipped = 0
        self._hub = hub
        self._number = 0

    async def next(self) -> LiveFrame | None:
        """The newest frame, as soon as there is one that this viewer has not got; None = the stream has ended."""
        frame = await self._hub.newer_than(self._number)
        if frame is not None:
            missed = frame.number - self._number - 1 if self._number else 0
            self.skipped += missed
            self._number = frame.number
            self._hub.note_sent(missed)
        return frame


class LiveHub:
    """Holds the newest frame only; waiting for a newer one costs nobody else anything."""

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

    def publish(
        self, message: CompositeMessage, jpeg: bytes, scene: ShownScene | None, renderer: str
    ) -> None:
        """Make this composite the newest and wake all who wait (any thread)."""
        now_s = time.monotonic()
        with self._lock:
            self._arrivals_s.append(now_s)
            number = 1 if self._newest is None else self._newest.number + 1
            facts = self._facts(number, message, scene, renderer)
            self._newest = LiveFrame(number, message, jpeg, now_s, time.time_ns(), facts)
        self._wake_soon()

    def close(self) -> None:
        """End the stream of every viewer (any thread)."""
        self._ended = True
        self._wake_soon()

    @contextmanager
    def viewer(self) -> Iterator[Viewer]:
        """A place in the stream (in the event loop)."""
        self.viewers += 1
        try:
            yield Viewer(self)
        finally:
            self.viewers -= 1

    @property
    def received(self) -> int:
        """How many frames came."""
        return 0 if self._newest is None else self._newest.number

    @property
    def newest(self) -> LiveFrame | None:
        """The newest frame, if any came."""
        return self._newest

    async def newer_than(self, number: int) -> LiveFrame | None:
        """The newest frame, as soon as there is one after `number`; None = the stream has ended."""
        while not self._ended:
            arrived = self._arrived
            if self._newest is not None and self._newest.number > number:
                return self._newest
            await arrived.wait()
        return None

    def note_sent(self, missed: int) -> None:
        """Count a frame that a viewer takes, and those that it missed since its last."""
        self.sent += 1
        self.skipped += missed

    def state(self) -> tuple[Literal["waiting", "ok", "stale"], float | None]:
        """Whether frames come, and the seconds since the newest did."""
        if self._newest is None:
            return "waiting", None
        since_s = time.monotonic() - self._newest.arrived_s
        return ("ok" if since_s < STALE_AFTER_S else "stale"), since_s

    def frames_per_s(self) -> float | None:
        """Rate of arrival over the last seconds; None before the second frame."""
        with self._lock:
            return self._rate()

    def _rate(self) -> float | None:
        oldest_s = time.monotonic() - RATE_WINDOW_S
        while len(self._arrivals_s) > 2 and self._arrivals_s[0] < oldest_s:
            self._arrivals_s.popleft()
        if len(self._arrivals_s) < 2:
            return None
        span_s = self._arrivals_s[-1] - self._arrivals_s[0]
        return (len(self._arrivals_s) - 1) / span_s if span_s > 0 else None

    def _facts(
        self, number: int, message: CompositeMessage, scene: ShownScene | None, renderer: str
    ) -> bytes:
        facts: dict[str, Any] = {
            "number": number,
            "frame_id": message.frame_id,
            "capture_ns": message.capture_ns,
            "frames_per_s": self._rate(),
            "status": message.status,
            "drops": message.drops,
            "pass_times_ms": message.pass_times_ms,
            "lights": message.lights,
            "camera": message.camera,
            "world_from_camera": message.world_from_camera,
            "scene": None if scene is None else {"id": scene.id, "revision": scene.revision},
            "renderer": renderer,
        }
        return json.dumps(facts).encode()[1:]

    def _wake_soon(self) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        arrived, self._arrived = self._arrived, asyncio.Event()
        arrived.set()
