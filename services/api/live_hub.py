"""The newest composite of each camera, shared by any number of viewers, each at its own pace."""

import asyncio
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Literal

from deltalight.protocol.messages import CameraEntry, CamerasMessage, CompositeMessage
from deltalight.protocol.scene_fields import ShownView
from deltalight.services.api.live_feed import CameraFeed
from deltalight.services.api.live_frame import LiveFrame
from deltalight.services.api.live_video import LiveCodec, LiveVideo, VideoPicture, VideoTrack
from deltalight.services.storage.faults import NotFoundError

WINDOW = 2  # frames in flight to one viewer before it has to acknowledge
VIDEO_WINDOW = 4  # the same for small pictures that build on each other: a gap costs a key
NO_CAMERA = "none has sent a frame yet"


class Viewer:
    """One viewer of the stream; `skipped` counts the frames that it was not sent.

    It looks at `view`; None = the scene's own. `codec` is what it would like the pictures to be coded as, `camera`
    whose pictures it sees; None = the first one's.
    """

    def __init__(self, hub: "LiveHub", view: ShownView | None, codec: LiveCodec, camera: str | None) -> None:
        self.skipped = 0
        self.view = view
        self.codec = codec
        self.camera = camera
        self.hub = hub
        self._last: LiveFrame | None = None
        self._track: VideoTrack | None = None
        self._coded: int | None = None  # its last picture in that track

    @property
    def window(self) -> int:
        """How many messages may be on their way to it unacknowledged."""
        return VIDEO_WINDOW if self.codec == "h264" else WINDOW

    def look_at(self, view: ShownView | None) -> None:
        """Looks at another view, as soon as a frame shows it."""
        self.view = view
        self.hub.note_views()

    def prefer(self, codec: LiveCodec) -> None:
        """Takes pictures coded so from now on, where they are there."""
        if codec != self.codec:
            self.codec = codec
            self.hub.wake()

    def turn_to(self, camera: str | None) -> None:
        """Sees the pictures of another camera from now on.

        Raises:
            NotFoundError: there is no such camera.
        """
        self.hub.require(camera)
        self.camera = camera
        self.hub.wake()

    def leave(self) -> None:
        """Leaves the encoded pictures that it followed."""
        if self._track is not None:
            self.hub.video.leave(self._track)
        self._track = self._coded = None

    async def next(self) -> LiveFrame | None:
        """Waits for a frame newer than this viewer's last; None = the stream has ended."""
        while not self.hub.has_ended:
            arrived = self.hub.arrival(self.camera)
            newest = self._newer()
            if newest is not None:
                self._take(newest)
                return newest
            await arrived.wait()
        return None

    async def next_message(self) -> bytes | None:
        """Waits for the next message, in H.264 where that is wanted and there; None = the stream has ended."""
        while not self.hub.has_ended:
            arrived = self.hub.arrival(self.camera)
            picture = self._next_coded()
            if picture is not None:
                self._take(picture.frame)
                return picture.packed(self.skipped)
            newest = None if self._is_coded else self._newer()
            if newest is not None:
                self._take(newest)
                return newest.packed(self.view, self.skipped)
            await arrived.wait()
        return None

    async def next_video(self) -> VideoPicture | None:
        """Waits for the next picture in H.264; None = the stream has ended, or there is no H.264 (any more)."""
        while not self.hub.has_ended and self.hub.video.why_not is None:
            arrived = self.hub.arrival(self.camera)
            picture = self._next_coded()
            if picture is not None:
                self._take(picture.frame)
                return picture
            if self._track is not None and self._track.has_failed:
                return None
            await arrived.wait()
        return None

    def want_key(self) -> None:
        """Goes on with a key: what came before was lost."""
        self._coded = None
        self.hub.wake()

    @property
    def _is_coded(self) -> bool:
        return self._track is not None and not self._track.has_failed

    def _newer(self) -> LiveFrame | None:
        """Returns its camera's newest frame, unless that was its last."""
        newest = self.hub.newest_of(self.camera)
        return None if newest is None or newest is self._last else newest

    def _next_coded(self) -> VideoPicture | None:
        newest = self.hub.newest_of(self.camera)
        if newest is None:
            return None
        track = self._followed(newest)
        picture = None if track is None else track.after(self._coded)
        if picture is not None:
            self._coded = picture.number
        return picture

    def _followed(self, newest: LiveFrame) -> VideoTrack | None:
        """Follows the track of what this viewer sees, if it wants one; one that failed is not followed."""
        view = newest.shown(self.view) if self.codec == "h264" and self.hub.video.why_not is None else None
        if self._track is not None and not (self._track.is_of(newest) and self._track.view == view):
            self.leave()
        if self._track is None and view is not None:
            self._track = self.hub.video.join(view, newest)
        return self._track if self._is_coded else None

    def _take(self, frame: LiveFrame) -> None:
        last = self._last
        follows = last is not None and last.message.node == frame.message.node
        missed = max(0, frame.number - last.number - 1) if last is not None and follows else 0
        self.skipped += missed
        self._last = frame
        self.hub.note_sent(missed)


class LiveHub:
    """Holds only the newest frame of each camera; viewers that wait for a newer one do not delay each other.

    A render server's only camera has no name in its composites; from the second one on, each names its own.
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
        self.received = 0  # of all cameras together
        self._cameras: CamerasMessage | None = None
        self._feeds: dict[str, CameraFeed] = {}  # replaced, never changed, so that all threads may look
        self._last = CameraFeed()  # of the newest frame of any
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._arrivals: dict[str | None, asyncio.Event] = {}  # by the camera that viewers wait for
        self.has_ended = False
        self.video = LiveVideo(self._publish_coded, on_failure)

    def attach(self, loop: asyncio.AbstractEventLoop) -> None:
        """Wakes viewers in this event loop from now on."""
        self._loop = loop

    def publish(self, message: CompositeMessage, jpegs: Sequence[bytes], renderer: str) -> None:
        """Publishes a composite as the newest, and wakes all waiting viewers (any thread).

        `jpegs` are its own picture, then those of its `others`.

        Raises:
            DeltalightError: its header is invalid.
        """
        node = message.node
        with self._lock:
            feed = self._feeds.get(node) or CameraFeed()
            frame = feed.publish(message, jpegs, renderer, node if self._names(node) else None)
            self._feeds = {**self._feeds, node: feed}
            self._last = feed
            self.received += 1
        self.video.offer(frame)
        self._wake_soon(feed)

    def note_cameras(self, message: CamerasMessage) -> bool:
        """Takes which cameras there are (any thread); returns whether that, or which of them live, is another."""
        before = [(each.node, each.status) for each in self.cameras]
        with self._lock:
            self._cameras = message
            kept = {each.node for each in self.cameras} if len(self.cameras) > 1 else {message.node}
            self._feeds = {node: feed for node, feed in self._feeds.items() if node in kept}
        self._wake_soon()
        return before != [(each.node, each.status) for each in message.cameras]

    def close(self) -> None:
        """Ends the stream of every viewer (any thread)."""
        self.has_ended = True
        self.video.close()
        self._wake_soon()

    @property
    def viewers(self) -> int:
        """The number of viewers."""
        return len(self._viewers)

    @contextmanager
    def viewer(
        self, view: ShownView | None = None, codec: LiveCodec = "jpeg", camera: str | None = None
    ) -> Iterator[Viewer]:
        """Joins the stream for the duration of the block (in the event loop)."""
        viewer = Viewer(self, view, codec, camera)
        self._viewers.add(viewer)
        self.note_views()
        try:
            yield viewer
        finally:
            self._viewers.remove(viewer)
            viewer.leave()
            self.note_views()

    def note_views(self) -> None:
        """Tells which views are looked at, if that changed."""
        watched = sorted({each.view for each in self._viewers if each.view is not None})
        if watched != self._watched:
            self._watched = watched
            self._on_watch(watched)

    @property
    def cameras(self) -> tuple[CameraEntry, ...]:
        """The cameras that the render server named, in their order."""
        return () if self._cameras is None else self._cameras.cameras

    def require(self, camera: str | None) -> None:
        """Refuses a camera that is not there.

        Raises:
            NotFoundError: the render server named no such camera.
        """
        names = [each.node for each in self.cameras]
        if camera is None or camera in names:
            return
        there = f"there {'are' if len(names) > 1 else 'is'} {', '.join(names)}" if names else NO_CAMERA
        raise NotFoundError(f"there is no camera {camera!r:.80}; {there}.")

    def server_of(self, message: CompositeMessage) -> str:
        """Returns the name of the render server that a composite is from."""
        server = self._cameras
        return server.node if server is not None and self._names(message.node) else message.node

    def feed(self, camera: str | None) -> CameraFeed:
        """Returns a camera's pictures; for None and one that is gone, those of the first camera that lives."""
        cameras, feeds = self.cameras, self._feeds
        if len(cameras) <= 1:
            return self._last
        if any(each.node == camera for each in cameras):
            return feeds.get(str(camera)) or CameraFeed()
        live = (feeds[each.node] for each in cameras if each.status == "live" and each.node in feeds)
        return next(live, self._last)

    def newest_of(self, camera: str | None) -> LiveFrame | None:
        """Returns the newest frame of what `feed` returns, if any arrived."""
        return self.feed(camera).newest

    @property
    def newest(self) -> LiveFrame | None:
        """The first camera's newest frame, if any arrived."""
        return self.newest_of(None)

    def note_sent(self, missed: int) -> None:
        """Counts a frame that a viewer takes, and those that it missed since its last one."""
        self.sent += 1
        self.skipped += missed

    def state(self, camera: str | None = None) -> tuple[Literal["waiting", "ok", "stale"], float | None]:
        """Returns whether frames arrive, and the seconds since the newest did."""
        return self.feed(camera).state()

    def frames_per_s(self, camera: str | None = None) -> float | None:
        """Returns the rate of arrival over the last seconds; None before the second frame."""
        with self._lock:
            return self.feed(camera).rate()

    def _names(self, node: str) -> bool:
        """Whether a composite of this `node` names a camera."""
        return len(self.cameras) > 1 and any(each.node == node for each in self.cameras)

    def _wake_soon(self, feed: CameraFeed | None = None) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self.wake, feed)

    def _publish_coded(self, note: Callable[[], None]) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(note)
        self._wake_soon()

    def arrival(self, camera: str | None) -> asyncio.Event:
        """Returns what is set as soon as viewers of a camera may have something new to take (in the event loop)."""
        return self._arrivals.setdefault(camera, asyncio.Event())

    def wake(self, feed: CameraFeed | None = None) -> None:
        """Has viewers look what they can take: those whom `feed` shows to, None = all (in the event loop)."""
        for camera in [each for each in self._arrivals if feed is None or self.feed(each) is feed]:
            self._arrivals.pop(camera).set()
