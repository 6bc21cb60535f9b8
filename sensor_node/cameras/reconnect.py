"""A live camera that reconnects: after a failure or stall it is reopened, at growing intervals."""

import threading
import time
from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass, replace

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.sensor_node.cameras.base import Camera, EndOfStream, ImuSample, StaleFrameError, StreamState
from deltalight.sensor_node.cameras.fitting_frames import require_fitting

FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 10.0
# Frames buffered for a late reader: an eighth of a second at 30 per second.
KEPT_FRAMES = 4
# How long `close` waits for a hanging driver; its thread ends by itself afterwards.
CLOSE_S = 1.0


@dataclass(frozen=True)
class _Kept:
    frame: SensorFrame
    capture_ns: int


class ReconnectingCamera(Camera):
    """Reads `inner` in a thread and reopens it after a failure: after 0.5 s, then 1 s, 2 s ... 10 s.

    Frame ids and timestamps keep rising across reopening; missing ids are frames that nobody took in time, or that
    the camera lost. The first `open` fails like the camera's own; `state` reports later failures.

    Args:
        inner: the camera; its `interrupt` must end a waiting `read`, unless that ends by itself.
        name: how to call it in sentences.
        stall_s: time without a frame after which it counts as failed.
        first_wait_s: time before the first attempt to reopen it.
    """

    def __init__(
        self, inner: Camera, name: str, *, stall_s: float = 2.0, first_wait_s: float = FIRST_WAIT_S
    ) -> None:
        self._inner, self._name = inner, name
        self._stall_s, self._first_wait_s = stall_s, first_wait_s
        self._changed = threading.Condition()
        self._kept: deque[_Kept] = deque(maxlen=KEPT_FRAMES)
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._fault: str | None = None
        self._is_given_up = False
        self._retry_at = self._seen_at = time.monotonic()
        self._exposure: tuple[float, Future[None]] | None = None
        self._numbering = _Numbering()
        self._capture_ns = 0
        self._describe()

    def open(self) -> None:
        """Opens the camera and starts reading.

        Raises:
            DeltalightError: it cannot be opened, or its driver still hangs in an earlier read.
        """
        self.close()
        if self._thread is not None:
            raise DeltalightError(
                f"{self._name} hangs in its driver; unplug it and plug it in again, or restart the node."
            )
        self._inner.open()
        self._closing.clear()
        self._kept.clear()
        self._back()
        self._thread = threading.Thread(target=self._run, name=f"camera {self._name}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stops reading and releases the device."""
        self.interrupt()
        if self._thread is not None:
            self._thread.join(CLOSE_S)
            self._thread = self._thread if self._thread.is_alive() else None

    def interrupt(self) -> None:
        """Ends a waiting `read` and the attempts to reopen the camera."""
        self._closing.set()
        self._inner.interrupt()
        with self._changed:
            self._changed.notify_all()

    @property
    def capture_ns(self) -> int:
        """Capture time of the last returned frame, in ns since 1970 by this host's clock."""
        return self._capture_ns

    @property
    def state(self) -> StreamState:
        """`live`, `stale` (no frame for longer than the stall time) or `lost` (closed, to be reopened)."""
        with self._changed:
            now = time.monotonic()
            if self._fault is not None:
                wait_s = self._retry_at - now
                again = f"in {wait_s:.0f} s" if wait_s >= 0.5 else "now"
                return StreamState("lost", f"{self._fault}; trying again {again}")
            if now - self._seen_at >= self._stall_s:
                return StreamState(
                    "stale", f"{self._name} has given no frame for {now - self._seen_at:.1f} s"
                )
            remark = getattr(self._inner, "remark", "")
            return StreamState("live", f"{self._name}: {remark}" if remark else "live")

    def set_exposure(self, seconds: float) -> None:
        """Locks the exposure between two frames.

        Raises:
            DeltalightError: the camera cannot, or it is disconnected.
        """
        done: Future[None] = Future()
        with self._changed:
            if self._fault is not None or self._closing.is_set():
                raise self._away()
            self._exposure = seconds, done
        try:
            done.result(self._stall_s)
        except TimeoutError:
            raise self._away() from None

    def imu_samples(self) -> list[ImuSample]:
        """Returns the inertial unit's measurements since the last call; none while the camera is disconnected."""
        with self._changed:
            return [] if self._fault is not None else self._inner.imu_samples()

    def read(self) -> SensorFrame:
        """Waits for the next frame, however long the camera is disconnected."""
        with self._changed:
            while not self._kept and not self._closing.is_set():
                self._wait()
            if self._closing.is_set():
                raise EndOfStream
            return self._give(self._kept.popleft())

    def read_latest(self, max_age_s: float) -> SensorFrame:
        """Returns the newest frame at once."""
        with self._changed:
            if self._closing.is_set():
                raise EndOfStream
            age_s = time.monotonic() - self._seen_at
            if not self._kept or age_s > max_age_s:
                raise StaleFrameError(
                    f"{self._name} has given no new frame for {age_s:.2f} s; see its state."
                )
            newest = self._kept.pop()
            self._kept.clear()
            return self._give(newest)

    def _away(self) -> DeltalightError:
        return DeltalightError(f"{self._name} is away; its exposure is not set.")

    def _give(self, kept: _Kept) -> SensorFrame:
        self._capture_ns = kept.capture_ns
        return kept.frame

    def _wait(self) -> None:
        """Waits for a frame; a stalled camera is told to end its read, which then counts as a failure."""
        left_s = self._seen_at + self._stall_s - time.monotonic()
        if left_s <= 0 and self._fault is None and not self._is_given_up:
            self._is_given_up = True
            self._inner.interrupt()
        self._changed.wait(left_s if left_s > 0 else self._stall_s)

    def _run(self) -> None:
        wait_s = self._first_wait_s
        while not self._closing.is_set():
            try:
                if self._fault is not None:
                    self._inner.open()
                    self._back()
                self._read_one()
                wait_s = self._first_wait_s
            except Exception as error:  # whatever a driver raises, the camera may come back
                if self._closing.is_set():
                    break
                self._lose(error, wait_s)
                self._closing.wait(wait_s)
                wait_s = min(2 * wait_s, LONGEST_WAIT_S)
        self._inner.close()
        self._refuse_exposure()

    def _read_one(self) -> None:
        frame = self._inner.read()
        require_fitting(frame, self._name)
        with self._changed:
            self._kept.append(_Kept(self._numbering.numbered(frame), self._inner.capture_ns))
            self._seen_at, self._is_given_up = time.monotonic(), False
            self._changed.notify_all()
        self._change_exposure()

    def _change_exposure(self) -> None:
        with self._changed:
            request, self._exposure = self._exposure, None
        if request is None:
            return
        seconds, done = request
        try:
            self._inner.set_exposure(seconds)
            done.set_result(None)
        except DeltalightError as error:
            done.set_exception(error)

    def _refuse_exposure(self) -> None:
        """Wakes those who wait for an exposure that will not be set."""
        with self._changed:
            request, self._exposure = self._exposure, None
        if request is not None:
            request[1].set_exception(self._away())

    def _lose(self, error: Exception, wait_s: float) -> None:
        self._inner.close()
        with self._changed:
            if not isinstance(error, EndOfStream):
                self._fault = str(error).rstrip(".") or type(error).__name__
            elif self._is_given_up:
                self._fault = f"{self._name} gave no frame for {self._stall_s:g} s"
            else:
                self._fault = f"{self._name} ended"
            self._retry_at = time.monotonic() + wait_s
        self._refuse_exposure()

    def _back(self) -> None:
        self._describe()
        with self._changed:
            self._fault, self._is_given_up, self._seen_at = None, False, time.monotonic()
            self._numbering.restart()

    def _describe(self) -> None:
        """Copies the camera's properties; a live one may know its lens only once it is open."""
        inner = self._inner
        if hasattr(inner, "camera"):
            self.camera = inner.camera
        self.board, self.extrinsics, self.depth_scale = inner.board, inner.extrinsics, inner.depth_scale
        self.exposure_is_measured = inner.exposure_is_measured


class _Numbering:
    """Frame ids and timestamps that keep rising when a camera restarts; gaps in its own ids stay."""

    def __init__(self) -> None:
        self._next_id, self._last_ns = 0, 0
        self._offset: int | None = None

    def restart(self) -> None:
        self._offset = None

    def numbered(self, frame: SensorFrame) -> SensorFrame:
        if self._offset is None:
            self._offset = self._next_id - frame.frame_id
        frame_id = max(frame.frame_id + self._offset, self._next_id)
        later_ns = max(self._last_ns + 1 - frame.timestamp_ns, 0)
        self._next_id, self._last_ns = frame_id + 1, frame.timestamp_ns + later_ns
        depth_ns = frame.depth_timestamp_ns
        return replace(
            frame,
            frame_id=frame_id,
            timestamp_ns=self._last_ns,
            depth_timestamp_ns=None if depth_ns is None else depth_ns + later_ns,
        )
