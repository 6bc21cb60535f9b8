"""The newest composite, shared by any number of viewers, each at its own pace."""

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

from deltalight.protocol.messages import CompositeMessage
from deltalight.protocol.scene_fields import ShownView
from deltalight.services.live_message import PictureHeader, ViewerHeader, age_ms, pack

RATE_WINDOW_S = 3.0
STALE_AFTER_S = 2.0


@dataclass(frozen=True)
class LivePicture:
    """A picture as JPEG, and its `PictureHeader` as JSON."""

    header: bytes
    jpeg: bytes


@dataclass(frozen=True)
class LiveFrame:
    """A composite for viewers; `number` counts the frames that arrived.

    It arrived at `arrived_s` of the monotonic clock and `arrived_ns` of this host's. `pictures` holds the scene's own
    view, first, and those that somebody asked for.
    """

    number: int
    message: CompositeMessage
    arrived_s: float
    arrived_ns: int
    pictures: Mapping[ShownView, LivePicture]

    def picture(self, view: ShownView | None) -> LivePicture:
        """Return the picture in a view; the scene's own where it is not there (yet), and for None."""
        own = self.pictures[self.message.view]
        return own if view is None else self.pictures.get(view, own)

    def packed(self, view: ShownView | None, skipped: int) -> bytes:
        """Return the message for a viewer of `view` that was not sent `skipped` frames."""
        picture = self.picture(view)
        return pack(picture.header, ViewerHeader(age_ms=age_ms(self.message), skipped=skipped), picture.jpeg)


class Viewer:
    """One viewer of the stream; `skipped` counts the frames that it was not sent.

    It looks at `view`; None = the scene's own.
    """

    def __init__(self, hub: "LiveHub", view: ShownView | None) -> None:
        self.skipped = 0
        self.view = view
        self._hub = hub
        self._number = 0

    def look_at(self, view: ShownView | None) -> None:
        """Look at another view, as soon as a frame shows it."""
        self.view = view
        self._hub.note_views()

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
    """Holds only the newest frame; viewers that wait for a newer one do not delay each other.

    `on_watch` is called in the event loop with the views that are looked at beside the scene's own, when they change.
    """

    def __init__(self, on_watch: Callable[[Sequence[ShownView]], None] = lambda _views: None) -> None:
        self._viewers: set[Viewer] = set()
        self._watched: list[ShownView] = []
        self._on_watch = on_watch
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

    def publish(self, message: CompositeMessage, jpegs: Sequence[bytes], renderer: str) -> None:
        """Publish a composite as the newest, and wake all waiting viewers (any thread).

        `jpegs` are its own picture, then those of its `others`.

        Raises:
            DeltalightError: its header is invalid.
        """
        now_s = time.monotonic()
        with self._lock:
            self._arrivals_s.append(now_s)
            number = 1 if self._newest is None else self._newest.number + 1
            header = PictureHeader.of(message, number=number, frames_per_s=self._rate(), renderer=renderer)
            headers = [header, *(header.model_copy(update=dict(other)) for other in message.others)]
            pictures = {
                each.view: LivePicture(each.model_dump_json().encode(), jpeg)
                for each, jpeg in zip(headers, jpegs, strict=True)
            }
            self._newest = LiveFrame(number, message, now_s, time.time_ns(), pictures)
        self._wake_soon()

    def close(self) -> None:
        """End the stream of every viewer (any thread)."""
        self._ended = True
        self._wake_soon()

    @property
    def viewers(self) -> int:
        """The number of viewers."""
        return len(self._viewers)

    @contextmanager
    def viewer(self, view: ShownView | None = None) -> Iterator[Viewer]:
        """Join the stream for the duration of the block (in the event loop)."""
        viewer = Viewer(self, view)
        self._viewers.add(viewer)
        self.note_views()
        try:
            yield viewer
        finally:
            self._viewers.remove(viewer)
            self.note_views()

    def note_views(self) -> None:
        """Tell which views are looked at, if that changed."""
        watched = sorted({each.view for each in self._viewers if each.view is not None})
        if watched != self._watched:
            self._watched = watched
            self._on_watch(watched)

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
