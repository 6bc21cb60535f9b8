"""Recorded frames behind the camera interface: in real time or as fast as possible."""

import threading
import time
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import FisheyePictures, SensorFrame
from deltalight.protocol.source import Source
from deltalight.sensor_node.cameras.base import Camera, EndOfStream, StaleFrameError

# Gap between the last frame and the first of the next round if a single frame has no period.
DEFAULT_PERIOD_NS = 33_333_333
# A clock that is only steered drifts by less within an hour; stamps then follow it in steps of this size.
CLOCK_STEP_NS = 10_000_000
# A replay that is further behind skips frames; it catches up with a shorter delay.
LATE_NS = 500_000_000


class PacedCamera(Camera):
    """Frames that are known in advance, handed out when they are due.

    In real time the first frame is due at `open`, the others later by their timestamps; a frame that is requested
    late is returned at once, with the capture time it would have had. Without real time each frame is captured when
    it is requested. In a loop, frame ids and timestamps keep rising, and a reader more than half a second behind
    misses frames, as with a camera; otherwise the delay would grow forever.
    """

    def __init__(self, timestamps_ns: Sequence[int], *, realtime: bool, loop: bool) -> None:
        if not timestamps_ns:
            raise DeltalightError("there are no frames to replay; choose a range that holds some.")
        self._times = np.asarray(timestamps_ns, np.int64)
        steps = np.array(
            [later - earlier for earlier, later in pairwise(timestamps_ns)] or [DEFAULT_PERIOD_NS]
        )
        self._round_ns = int(self._times[-1] - self._times[0]) + int(np.median(steps))
        self._realtime, self._loop = realtime, loop
        self._next = 0
        self._opened_monotonic_ns = self._opened_ns = self._capture_ns = 0
        self._interrupted = threading.Event()
        self._repeated: tuple[FisheyePictures, int, FisheyePictures] | None = None

    @abstractmethod
    def frame_at(self, index: int) -> SensorFrame:
        """Returns frame `index` of the first round, as recorded."""

    def open(self) -> None:
        """Starts the clock at the first frame."""
        self._next = 0
        self._interrupted.clear()
        self._opened_ns, self._opened_monotonic_ns = time.time_ns(), time.monotonic_ns()

    def close(self) -> None:
        """Ends any waiting `read`."""
        self.interrupt()

    def interrupt(self) -> None:
        """Makes a waiting `read`, and every later one until `open`, end with EndOfStream."""
        self._interrupted.set()

    @property
    def capture_ns(self) -> int:
        """Time at which the last returned frame was due, or requested, in ns since 1970 by this host's clock."""
        return self._capture_ns

    def read(self) -> SensorFrame:
        """Waits until the next frame is due and returns it."""
        if self._interrupted.is_set() or (not self._loop and self._next >= len(self._times)):
            raise EndOfStream
        if self._realtime and self._loop and self._elapsed_ns() - self._due_ns(self._next) > LATE_NS:
            self._next = self._newest(self._elapsed_ns())
        wait_ns = self._due_ns(self._next) - self._elapsed_ns() if self._realtime else 0
        if wait_ns > 0 and self._interrupted.wait(wait_ns / 1e9):
            raise EndOfStream
        return self._take(self._next)

    def read_latest(self, max_age_s: float) -> SensorFrame:
        """Returns the newest frame that is due; without real time, the next one."""
        if not self._realtime:
            return self.read()
        if self._interrupted.is_set():
            raise EndOfStream
        elapsed = self._elapsed_ns()
        newest = self._newest(elapsed)
        age_s = (elapsed - self._due_ns(newest)) / 1e9
        if age_s > max_age_s:
            raise StaleFrameError(
                f"the newest frame is {age_s:.2f} s old, {max_age_s:g} s are allowed; see if capture ended."
            )
        return self._take(newest)

    def _elapsed_ns(self) -> int:
        return time.monotonic_ns() - self._opened_monotonic_ns

    def _due_ns(self, number: int) -> int:
        """Returns the time after `open` at which frame `number`, counted over all rounds, is due."""
        rounds, index = divmod(number, len(self._times))
        return rounds * self._round_ns + int(self._times[index] - self._times[0])

    def _newest(self, elapsed_ns: int) -> int:
        rounds, rest = divmod(elapsed_ns, self._round_ns)
        if not self._loop and rounds > 0:
            return len(self._times) - 1
        return (
            rounds * len(self._times) + int(np.searchsorted(self._times - self._times[0], rest, "right")) - 1
        )

    def _take(self, number: int) -> SensorFrame:
        rounds, index = divmod(number, len(self._times))
        elapsed = self._due_ns(number) if self._realtime else self._elapsed_ns()
        opened_ns = time.time_ns() - self._elapsed_ns()
        if abs(opened_ns - self._opened_ns) > CLOCK_STEP_NS:  # this host's clock was set meanwhile
            self._opened_ns = opened_ns
        self._capture_ns = self._opened_ns + elapsed
        self._next = number + 1
        frame = self.frame_at(index)
        if rounds == 0:
            return frame
        later = rounds * self._round_ns
        depth_ns = frame.depth_timestamp_ns
        return replace(
            frame,
            frame_id=frame.frame_id + rounds * len(self._times),
            timestamp_ns=frame.timestamp_ns + later,
            depth_timestamp_ns=None if depth_ns is None else depth_ns + later,
            fisheye=None if frame.fisheye is None else self._fisheye_of_round(frame.fisheye, later),
        )

    def _fisheye_of_round(self, pictures: FisheyePictures, later_ns: int) -> FisheyePictures:
        """Returns the pictures with the time of this round, the same object while they are current."""
        known = self._repeated
        if known is None or known[0] is not pictures or known[1] != later_ns:
            shifted = replace(pictures, timestamp_ns=pictures.timestamp_ns + later_ns)
            known = self._repeated = pictures, later_ns, shifted
        return known[2]


class ReplayCamera(PacedCamera):
    """The frames [start, stop) of a dataset folder or recording.

    Args:
        source: what to replay.
        realtime: obey the recorded times; otherwise frames come as fast as they are requested.
        loop: restart after the last frame.
        start: first frame.
        stop: frame after the last one; None = to the end.
    """

    def __init__(
        self,
        source: Source,
        *,
        realtime: bool = True,
        loop: bool = False,
        start: int = 0,
        stop: int | None = None,
    ) -> None:
        self._frames = range(len(source))[start:stop]
        times = source.timestamps_ns
        super().__init__([times[index] for index in self._frames], realtime=realtime, loop=loop)
        self._source = source
        self.camera, self.board, self.extrinsics = source.camera, source.board, source.extrinsics
        self.depth_scale, self.notes = source.depth_scale, source.notes

    def frame_at(self, index: int) -> SensorFrame:
        """Returns the frame as recorded; its `frame_id` is that of the source."""
        return self._source[self._frames[index]]
