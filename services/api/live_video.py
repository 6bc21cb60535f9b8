"""H.264 for viewers of the live picture: one encoder a camera, view and size, shared by all who look at it."""

import json
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Literal

import structlog

from deltalight.protocol.codecs import decode_color
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_fields import ShownView
from deltalight.services.api.live_frame import LiveFrame
from deltalight.services.h264 import AccessUnit, H264Encoder, why_unavailable
from deltalight.services.live_message import pack

LiveCodec = Literal["jpeg", "h264"]

KEPT = 4  # newest pictures for viewers that are a little late; who is later goes on with a key
KEY_INTERVAL_S = 1.0  # between keys: viewers that cannot follow do not cost the others more
REFINED_AFTER = 16  # encodings of one picture; then it is as good as this encoder makes it

log = structlog.get_logger()


@dataclass(frozen=True)
class VideoPicture:
    """A coded picture of `frame`, number `number` of its track; without `data` it is the one before.

    `header` is JSON: all of a `PictureHeader` for one that `is_key`, else only what differs from the picture before.
    """

    number: int
    frame: LiveFrame
    header: bytes
    data: bytes
    is_key: bool

    def packed(self, skipped: int) -> bytes:
        """Returns the message for a viewer that was not sent `skipped` frames."""
        return pack(self.header, self.frame.viewer_header(skipped), self.data)


class VideoTrack:
    """The pictures of a camera in a view as H.264, encoded in a thread of their own: always the newest.

    `node` is what their composites name.

    `publish` is called in that thread with what to do in the event loop, where all else here but `offer` happens.
    Where the encoder fails the track ends; `on_failure` is told why, in that thread.
    """

    def __init__(
        self,
        node: str,
        view: ShownView,
        publish: Callable[[Callable[[], None]], None],
        on_failure: Callable[[str], None],
    ) -> None:
        self.node = node
        self.view = view
        self.has_failed = False
        self.members = 0
        self._publish, self._on_failure = publish, on_failure
        self._pictures: deque[VideoPicture] = deque(maxlen=KEPT)
        self._changed = threading.Condition()
        self._fresh: LiveFrame | None = None
        self._last: LiveFrame | None = None
        self._is_key_wanted, self._key_due_s = False, 0.0
        self._is_closed = False
        self._coder = _Coder(view)
        self._thread = threading.Thread(target=self._run, name="live-video")

    def is_of(self, frame: LiveFrame) -> bool:
        """Whether it is of the camera of a frame."""
        return self.node == frame.message.node

    def start(self, frame: LiveFrame) -> None:
        """Begins with a frame that has arrived."""
        self._fresh = frame
        self._thread.start()

    def offer(self, frame: LiveFrame) -> None:
        """Encodes a frame next, unless a newer one comes before (any thread)."""
        with self._changed:
            self._fresh = frame
            self._changed.notify()

    def after(self, number: int | None) -> VideoPicture | None:
        """Returns the picture after `number`, or the newest key if that is gone or for None; None = wait for it."""
        newest = self._pictures[-1].number if self._pictures else None
        if number is not None and number == newest:
            return None
        found = [each for each in self._pictures if number is not None and each.number == number + 1]
        found += [each for each in reversed(self._pictures) if each.is_key]
        if not found:
            self._ask_for_key()
            return None
        return found[0]

    def close(self) -> None:
        """Ends the thread soon."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()

    def _ask_for_key(self) -> None:
        with self._changed:
            self._is_key_wanted = True
            self._changed.notify()

    def _run(self) -> None:
        while (job := self._next_job()) is not None:
            try:
                picture = self._coder.encode(*job)
            except (DeltalightError, OSError, ValueError, MemoryError) as fault:
                log.warning("live video goes on as JPEG", view=self.view, fault=str(fault))
                self._on_failure(f"Live video goes on as JPEG: {fault}")
                self._publish(self._fail)
                return
            if picture.is_key:
                self._key_due_s = time.monotonic() + KEY_INTERVAL_S
            self._publish(partial(self._note, picture))

    def _next_job(self) -> tuple[LiveFrame, bool] | None:
        """Waits for a frame, or for a key of the last one being due; None = the track is closed."""
        with self._changed:
            while not self._is_closed:
                wait_s = self._key_due_s - time.monotonic()
                is_due = self._is_key_wanted and wait_s <= 0
                frame = self._fresh or (self._last if is_due else None)
                if frame is not None:
                    self._fresh, self._last = None, frame
                    self._is_key_wanted = self._is_key_wanted and not is_due
                    return frame, is_due
                waits_for_key = self._is_key_wanted and self._last is not None
                self._changed.wait(wait_s if waits_for_key else None)
            return None

    def _note(self, picture: VideoPicture) -> None:
        self._pictures.append(picture)
        if picture.is_key:
            with self._changed:
                self._is_key_wanted = False  # also by those who asked while it was made

    def _fail(self) -> None:
        self.has_failed = True


class _Coder:
    """Encodes one track's frames, with a new encoder where their size becomes another."""

    def __init__(self, view: ShownView) -> None:
        self._view = view
        self._encoder: H264Encoder | None = None
        self._size: tuple[int, int] | None = None
        self._header: dict[str, Any] = {}
        self._jpeg, self._repeats, self._number = b"", 0, 0

    def encode(self, frame: LiveFrame, is_key_wanted: bool) -> VideoPicture:
        """Encodes the picture of the track's view.

        Raises:
            DeltalightError: no encoder takes it.
        """
        picture = frame.picture(self._view)
        header = json.loads(picture.header)
        unit = self._unit(picture.jpeg, header["camera"], is_key_wanted)
        assert self._encoder is not None
        header |= {"codec": self._encoder.codec, "keyframe": unit.is_key}
        news = header if unit.is_key else _changes(self._header, header)
        self._header = header
        self._number += 1
        return VideoPicture(self._number, frame, json.dumps(news).encode(), unit.data, unit.is_key)

    def _unit(self, jpeg: bytes, camera: dict[str, Any], is_key_wanted: bool) -> AccessUnit:
        self._repeats = self._repeats + 1 if jpeg == self._jpeg else 0
        self._jpeg = jpeg
        if self._repeats > REFINED_AFTER and not is_key_wanted:
            return AccessUnit(b"", is_key=False)
        width, height = camera["width"], camera["height"]
        if self._encoder is None or self._size != (width, height):
            self._encoder, self._size = H264Encoder(width, height), (width, height)
            log.info("live video is encoded", encoder=self._encoder.name, size=f"{width}x{height}")
        pixels = decode_color(jpeg, "jpeg", (height, width, 3))
        return self._encoder.encode(pixels, as_key=is_key_wanted)


class LiveVideo:
    """The tracks that somebody looks at (in the event loop).

    `publish` runs something in the event loop and wakes the viewers; encoders' threads call it and `on_failure`.
    """

    def __init__(
        self, publish: Callable[[Callable[[], None]], None], on_failure: Callable[[str], None]
    ) -> None:
        self._publish, self._on_failure = publish, on_failure
        self._tracks: dict[tuple[str, ShownView], VideoTrack] = {}

    @cached_property
    def why_not(self) -> str | None:
        """Why there is no H.264 here; None where there is. Found out when first asked for: PyAV is large."""
        return why_unavailable()

    @property
    def encoders(self) -> int:
        """The number of views that are encoded, each camera's for itself."""
        return len(self._tracks)

    def offer(self, frame: LiveFrame) -> None:
        """Encodes a new frame's pictures that somebody looks at (any thread)."""
        for track in self._tracks.copy().values():
            if track.is_of(frame) and track.view in frame.pictures:
                track.offer(frame)

    def join(self, view: ShownView, frame: LiveFrame) -> VideoTrack:
        """Returns the track of a frame's camera in a view, which begins with it if nobody looked there before."""
        key = frame.message.node, view
        track = self._tracks.get(key)
        if track is None:
            track = self._tracks[key] = VideoTrack(*key, self._publish, self._on_failure)
            track.start(frame)
        track.members += 1
        return track

    def leave(self, track: VideoTrack) -> None:
        """Leaves a track, which ends where nobody else looks at it."""
        track.members -= 1
        if track.members == 0:
            track.close()
            del self._tracks[track.node, track.view]

    def close(self) -> None:
        """Ends all threads soon (any thread)."""
        for track in self._tracks.copy().values():
            track.close()


def _changes(before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in after.items() if key not in before or before[key] != value}
