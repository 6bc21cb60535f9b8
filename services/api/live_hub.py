"""The newest composite, shared by any number of viewers, each at its own pace."""

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Literal

from deltalight.protocol.messages import CompositeMessage
from deltalight.protocol.scene_fields import ShownView
from deltalight.services.api.live_frame import LiveFrame, LivePicture
from deltalight.services.api.live_video import LiveCodec, LiveVideo, VideoPicture, VideoTrack
from deltalight.services.live_message import PictureHeader

WINDOW = 2  # frames in flight to one viewer before it has to acknowledge
VIDEO_WINDOW = 4  # the same for small pictures that build on each other: a gap costs a key
RATE_WINDOW_S = 3.0
STALE_AFTER_S = 2.0


class Viewer:
    """One viewer of the stream; `skipped` counts the frames that it was not sent.

    It looks at `view`; None = the scene's own. `codec` is what it would like the pictures to be coded as.
    """

    def __init__(self, hub: "LiveHub", view: ShownView | None, codec: LiveCodec) -> None:
        self.skipped = 0
        self.view = view
        self.codec = codec
        self._hub = hub
        self._number = 0
        self._track: VideoTrack | None = None
        self._coded: int | None = None  # its last picture in that track

    @property
    def window(self) -> int:
        """How many messages may be on their way to it unacknowledged."""
        return VIDEO_WINDOW if self.codec == "h264" else WINDOW

    def look_at(self, view: ShownView | None) -> None:
        """Look at another view, as soon as a frame shows it."""
        self.view = view
        self._hub.note_views()

    def prefer(self, codec: LiveCodec) -> None:
        """Take pictures coded so from now on, where they are there."""
        if codec != self.codec:
            self.codec = codec
            self._hub.wake()

    def leave(self) -> None:
        """Leave the encoded pictures that it followed."""
        if self._track is not None:
            self._hub.video.leave(self._track)
        self._track = self._coded = None

    async def next(self) -> LiveFrame | None:
        """Wait for a frame newer than this viewer's last; None = the stream has ended."""
        frame = await self._hub.newer_than(self._number)
        if frame is not None:
            self._take(frame)
        return frame

    async def next_message(self) -> bytes | None:
        """Wait for the next message, in H.264 where that is wanted and there; None = the stream has ended."""
        while not self._hub.has_ended:
            arrived = self._hub.arrived
            picture = self._next_coded()
            if picture is not None:
                self._take(picture.frame)
                return picture.packed(self.skipped)
            newest = self._hub.newest
            if not self._is_coded and newest is not None and newest.number > self._number:
                self._take(newest)
                return newest.packed(self.view, self.skipped)
            await arrived.wait()
        return None

    async def next_video(self) -> VideoPicture | None:
        """Wait for the next picture in H.264; None = the stream has ended, or there is no H.264 (any more)."""
        while not self._hub.has_ended and self._hub.video.why_not is None:
            arrived = self._hub.arrived
            picture = self._next_coded()
            if picture is not None:
                self._take(picture.frame)
                return picture
            if self._track is not None and self._track.has_failed:
                return None
            await arrived.wait()
        return None

    def want_key(self) -> None:
        """Go on with a key: what came before was lost."""
        self._coded = None
        self._hub.wake()

    @property
    def _is_coded(self) -> bool:
        return self._track is not None and not self._track.has_failed

    def _next_coded(self) -> VideoPicture | None:
        newest = self._hub.newest
        if newest is None:
            return None
        track = self._followed(newest)
        picture = None if track is None else track.after(self._coded)
        if picture is not None:
            self._coded = picture.number
        return picture

    def _followed(self, newest: LiveFrame) -> VideoTrack | None:
        """Follow the track of what this viewer sees, if it wants one; one that failed is not followed."""
        view = newest.shown(self.view) if self.codec == "h264" and self._hub.video.why_not is None else None
        if self._track is not None and self._track.view != view:
            self.leave()
        if self._track is None and view is not None:
            self._track = self._hub.video.join(view, newest)
        return self._track if self._is_coded else None

    def _take(self, frame: LiveFrame) -> None:
        missed = max(0, frame.number - self._number - 1) if self._number else 0
        self.skipped += missed
        self._number = frame.number
        self._hub.note_sent(missed)


class LiveHub:
    """Holds only the newest frame; viewers that wait for a newer one do not delay each other.

    `on_watch` is called in the event loop with the views that are looked at beside the scene's own, when they change,
    `on_failure` in any thread with why there is no H.264 any more.
    """

    def __init__(
        self,
        on_watch: Callable[[Sequence[ShownView]], None] = lambda _views: None,
        on_failure: Callable[[str], None] = lambda _reason: None,
    ) -> None:
        self._viewers: set[Viewer] = set()
        self._watched: list[ShownView] = []
        self._on_watch = on_watch
        self.sent = 0
        self.skipped = 0
        self._newest: LiveFrame | None = None
        self._arrivals_s: deque[float] = deque()
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self.arrived = asyncio.Event()  # set, and made anew, when anything came or the stream ended
        self.has_ended = False
        self.video = LiveVideo(self._publish_coded, on_failure)

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
            frame = self._newest = LiveFrame(number, message, now_s, time.time_ns(), pictures)
        self.video.offer(frame)
        self._wake_soon()

    def close(self) -> None:
        """End the stream of every viewer (any thread)."""
        self.has_ended = True
        self.video.close()
        self._wake_soon()

    @property
    def viewers(self) -> int:
        """The number of viewers."""
        return len(self._viewers)

    @contextmanager
    def viewer(self, view: ShownView | None = None, codec: LiveCodec = "jpeg") -> Iterator[Viewer]:
        """Join the stream for the duration of the block (in the event loop)."""
        viewer = Viewer(self, view, codec)
        self._viewers.add(viewer)
        self.note_views()
        try:
            yield viewer
        finally:
            self._viewers.remove(viewer)
            viewer.leave()
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
        while not self.has_ended:
            arrived = self.arrived
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
            self._loop.call_soon_threadsafe(self.wake)

    def _publish_coded(self, note: Callable[[], None]) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(note)
        self._wake_soon()

    def wake(self) -> None:
        """Have all viewers look what they can take (in the event loop)."""
        arrived, self.arrived = self.arrived, asyncio.Event()
        arrived.set()
