"""Playback of a recording while it is published: pause, seek, and playback rate."""

import math
import threading
import time
from dataclasses import dataclass, replace

import numpy as np

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import FisheyePictures, SensorFrame
from deltalight.protocol.source import Source
from deltalight.sensor_node.cameras.base import Camera, EndOfStream
from deltalight.sensor_node.cameras.replay import CLOCK_STEP_NS, DEFAULT_PERIOD_NS, LATE_NS

MIN_RATE, MAX_RATE = 0.05, 20.0
# Bounds of the period of repeating a frame that stands still: what moves in the scene goes on moving as it did.
LEAST_REPEAT_NS, MOST_REPEAT_NS = 66_666_667, 500_000_000
# Time between frames on both sides of a jump: longer than the memory of any filter.
JUMP_NS = 1_000_000_000


@dataclass(frozen=True)
class PlaybackState:
    """Position of a replay; times in seconds from the first frame of the recording."""

    position_s: float
    duration_s: float
    playing: bool
    rate: float
    loop: bool


class PlaybackCamera(Camera):
    """The frames of a recording in real time, controlled by other threads.

    Every frame is stamped with the moment at which it is due here, whatever its position in the recording: numbers,
    times and stamps keep rising after a pause, a seek or a new round, so that whoever pairs, smooths or records the
    streams sees one camera. While paused, the frame is repeated at the recording's rate, 2 to 15 times a second.

    Args:
        source: what to replay.
        loop: restart after the last frame.
        rate: recorded seconds per second.
        start_s: initial position, seconds from the first frame.
        playing: False starts paused.
        stays: wait at the end for another command instead of ending.

    Raises:
        DeltalightError: the rate is out of range.
    """

    def __init__(
        self,
        source: Source,
        *,
        loop: bool,
        rate: float = 1.0,
        start_s: float = 0.0,
        playing: bool = True,
        stays: bool = False,
    ) -> None:
        self._source = source
        self._times = np.asarray(source.timestamps_ns, np.int64)
        steps = np.diff(self._times)
        self._period_ns = int(np.median(steps)) if len(steps) else DEFAULT_PERIOD_NS
        self._repeat_ns = min(max(self._period_ns, LEAST_REPEAT_NS), MOST_REPEAT_NS)
        self._loop, self._stays, self._rate = loop, stays, _checked_rate(rate)
        self._playing = playing
        self._changed = threading.Condition()
        self._interrupted = False
        self._index = self._index_at(start_s)  # the frame that is due next, or shown
        self._is_shown = False
        self._jumped = False
        self._due_ns = 0  # monotonic time at which that frame was or is due
        self._wall_ns = self._capture_ns = 0
        self._numbered = _RisingNumbers(self._period_ns)
        self._read: tuple[int, SensorFrame] | None = None  # the last, which a pause repeats
        self.camera, self.board, self.extrinsics = source.camera, source.board, source.extrinsics
        self.depth_scale, self.notes = source.depth_scale, source.notes

    def open(self) -> None:
        """Starts the clock at the first frame."""
        with self._changed:
            self._interrupted = False
            self._begin(self._index)

    def close(self) -> None:
        """Ends any waiting `read`."""
        self.interrupt()

    def interrupt(self) -> None:
        """Makes a waiting `read`, and every later one until `open`, end with EndOfStream."""
        with self._changed:
            self._interrupted = True
            self._changed.notify_all()

    @property
    def capture_ns(self) -> int:
        """Time at which the last returned frame was due, in ns since 1970 by this host's clock."""
        return self._capture_ns

    @property
    def playback(self) -> PlaybackState:
        """Position of the replay (any thread)."""
        with self._changed:
            return PlaybackState(
                position_s=float(self._times[self._index] - self._times[0]) / 1e9,
                duration_s=float(self._times[-1] - self._times[0]) / 1e9,
                playing=self._playing,
                rate=self._rate,
                loop=self._loop,
            )

    def play(self) -> None:
        """Resumes, from the beginning if it is at the end (any thread)."""
        with self._changed:
            if not self._playing:
                self._playing = True
                is_at_end = self._index == len(self._times) - 1
                self._jumped |= is_at_end
                self._begin(0 if is_at_end else self._index, is_shown=not is_at_end)

    def pause(self) -> None:
        """Pauses at the current frame (any thread)."""
        with self._changed:
            self._playing = False
            self._changed.notify_all()

    def seek(self, position_s: float) -> None:
        """Continues at another position, seconds from the first frame, clamped to the recording (any thread).

        Raises:
            DeltalightError: the position is not a number.
        """
        with self._changed:
            self._jumped = True
            self._begin(self._index_at(position_s))

    def step(self, frames: int) -> None:
        """Goes to the frame so many after the current one, or before it, within the recording (any thread)."""
        with self._changed:
            self._jumped = True
            self._begin(min(max(self._index + frames, 0), len(self._times) - 1))

    def set_rate(self, rate: float) -> None:
        """Plays this many recorded seconds per second (any thread).

        Raises:
            DeltalightError: the rate is out of range.
        """
        with self._changed:
            self._rate = _checked_rate(rate)
            self._begin(self._index, is_shown=self._is_shown)

    def read(self) -> SensorFrame:
        """Waits for the next frame, or for the time to repeat the current one.

        Raises:
            EndOfStream: the recording has ended, and does not stay there.
        """
        with self._changed:
            index, due_ns = self._wait()
            jumped, self._jumped = self._jumped, False
            self._due_ns, self._index, self._is_shown = due_ns, index, True
            self._capture_ns = self._stamp_of(due_ns)
        if self._read is None or self._read[0] != index:
            self._read = index, self._source[index]
        return self._numbered(self._read[1], index, self._capture_ns, jumped=jumped)

    def read_latest(self, max_age_s: float) -> SensorFrame:  # noqa: ARG002 - a replayed frame is never old
        """Like `read`: no frame is newer than the one that is due."""
        return self.read()

    def _wait(self) -> tuple[int, int]:
        """Waits until a frame is due and returns its index and time (monotonic ns).

        Commands may change both meanwhile.
        """
        while not self._interrupted:
            index, due_ns = self._next()
            wait_ns = due_ns - time.monotonic_ns()
            if wait_ns <= 0:
                return index, due_ns
            self._changed.wait(wait_ns / 1e9)
        raise EndOfStream

    def _next(self) -> tuple[int, int]:
        if not self._is_shown:
            return self._index, self._due_ns
        if self._playing and self._index == len(self._times) - 1 and not self._loop:
            if not self._stays:
                raise EndOfStream
            self._playing = False
        if not self._playing:
            return self._index, self._due_ns + self._repeat_ns
        return self._following()

    def _following(self) -> tuple[int, int]:
        """Returns the next frame; if the replay is far behind, the newest that is due."""
        index, due_ns, late_ns = self._index, self._due_ns, time.monotonic_ns() - self._due_ns
        if index == len(self._times) - 1:
            return 0, due_ns + int(self._period_ns / self._rate)
        following = index + 1
        if late_ns > LATE_NS + self._period_ns / self._rate:
            reached_ns = self._times[index] + int(late_ns * self._rate)
            following = max(following, int(np.searchsorted(self._times, reached_ns, "right")) - 1)
        return following, due_ns + int((self._times[following] - self._times[index]) / self._rate)

    def _begin(self, index: int, *, is_shown: bool = False) -> None:
        """Makes a frame due now; unless it `is_shown` already, it is the target of a jump."""
        self._index, self._is_shown, self._due_ns = index, is_shown, time.monotonic_ns()
        self._changed.notify_all()

    def _index_at(self, position_s: float) -> int:
        if math.isnan(position_s):
            raise DeltalightError(f"{position_s} s is not a position in a recording; give a number.")
        wanted = self._times[0] + int(np.clip(position_s, 0, 1e9) * 1e9)
        return max(int(np.searchsorted(self._times, wanted, "right")) - 1, 0)

    def _stamp_of(self, due_ns: int) -> int:
        """Returns this host's clock at a monotonic time, even after the clock was set."""
        wall_ns = time.time_ns() - time.monotonic_ns()
        if abs(wall_ns - self._wall_ns) > CLOCK_STEP_NS:
            self._wall_ns = wall_ns
        return self._wall_ns + due_ns


class _RisingNumbers:
    """Gives frames rising numbers and times, whatever their positions in the recording."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._index, self._capture_ns = -1, 0
        self._last: SensorFrame | None = None
        self._shift_ns = self._shift_id = self._since_ns = 0
        self._pictures: tuple[FisheyePictures, FisheyePictures] | None = None

    def __call__(self, frame: SensorFrame, index: int, capture_ns: int, *, jumped: bool) -> SensorFrame:
        """Returns frame `index`, due at `capture_ns`, renumbered; `jumped` if a command selected it."""
        last, is_again = self._last, index == self._index
        if last is not None and (jumped or index <= self._index):
            gap_ns = JUMP_NS if jumped else capture_ns - self._capture_ns if is_again else self._period_ns
            self._shift_ns = last.timestamp_ns + gap_ns - frame.timestamp_ns
            self._shift_id = last.frame_id + 1 - frame.frame_id
            if not is_again:
                self._since_ns = frame.timestamp_ns + self._shift_ns
        self._index, self._capture_ns = index, capture_ns
        depth_ns, pictures = frame.depth_timestamp_ns, frame.fisheye
        self._last = replace(
            frame,
            frame_id=frame.frame_id + self._shift_id,
            timestamp_ns=frame.timestamp_ns + self._shift_ns,
            depth_timestamp_ns=None if depth_ns is None else depth_ns + self._shift_ns,
            fisheye=None if pictures is None else self._held(pictures),
        )
        return self._last

    def _held(self, pictures: FisheyePictures) -> FisheyePictures:
        """Returns the restamped pictures, not before the last jump; the same object while they are current."""
        if self._pictures is None or self._pictures[0] is not pictures:
            shown_ns = max(pictures.timestamp_ns + self._shift_ns, self._since_ns)
            self._pictures = pictures, replace(pictures, timestamp_ns=shown_ns)
        return self._pictures[1]


def _checked_rate(rate: float) -> float:
    if not MIN_RATE <= rate <= MAX_RATE:
        raise DeltalightError(f"a replay goes at a rate of {MIN_RATE:g} to {MAX_RATE:g}, not {rate:g}.")
    return float(rate)
