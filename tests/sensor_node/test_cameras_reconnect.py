"""Cameras that fail, stall and come back, in real threads."""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage, SensorFrame
from deltalight.sensor_node.cameras.base import Camera, EndOfStream, StaleFrameError, StreamState
from deltalight.sensor_node.cameras.live import CameraFailure
from deltalight.sensor_node.cameras.reconnect import ReconnectingCamera
from deltalight.sensor_node.capture import CaptureThread

CAMERA = CameraModel(8, 6, np.array([[6.0, 0, 3.5], [0, 6, 2.5], [0, 0, 1]]))
PERIOD_S = 0.005
WAIT_S = 20.0


class Scripted(Camera):
    """A camera whose ids begin at 0 whenever it is opened; `script` says what each frame number does, once.

    fail: unplugged; hang: no more frames until interrupted; end: ends by itself; crash: a driver's own exception.
    """

    def __init__(self, script: dict[int, str] | None = None, refuse_openings: int = 0) -> None:
        self.script = dict(script or {})
        self.refuse_openings = refuse_openings
        self.opened = self.closed = self.taken = 0
        self.exposures: list[float] = []
        self.is_open = False
        self._interrupted = threading.Event()
        self._number = 0

    def open(self) -> None:
        self.opened += 1
        if self.opened > 1 and self.refuse_openings > 0:
            self.refuse_openings -= 1
            raise CameraFailure("camera test is not there.")
        self.camera, self._number, self.is_open = CAMERA, 0, True
        self._interrupted.clear()

    def close(self) -> None:
        self.closed, self.is_open = self.closed + 1, False

    def read(self) -> SensorFrame:
        match self.script.pop(self.taken, ""):
            case "fail":
                raise CameraFailure("camera test was unplugged.")
            case "crash":
                raise OSError("X_LINK_ERROR")
            case "hang":
                self._interrupted.wait(WAIT_S)
            case "end":
                raise EndOfStream
        if self._interrupted.wait(PERIOD_S):
            raise EndOfStream
        self.taken, self._number = self.taken + 1, self._number + 1
        self._capture_ns = time.time_ns()
        color = np.zeros((6, 8, 3), np.uint8)
        # Its clock goes back when it is opened again.
        stamp_ns = 1_000_000_000 + self._number * 5_000_000
        return SensorFrame(self._number - 1, stamp_ns, color, CAMERA, depth_timestamp_ns=stamp_ns + 7)

    def read_latest(self, max_age_s: float) -> SensorFrame:  # noqa: ARG002 - each frame is new
        return self.read()

    @property
    def capture_ns(self) -> int:
        return self._capture_ns

    def interrupt(self) -> None:
        self._interrupted.set()

    def set_exposure(self, seconds: float) -> None:
        if seconds > 1:
            raise DeltalightError("too long for this camera.")
        self.exposures.append(seconds)


def reconnecting(inner: Camera, stall_s: float = 5.0, first_wait_s: float = 0.02) -> ReconnectingCamera:
    return ReconnectingCamera(inner, "test", stall_s=stall_s, first_wait_s=first_wait_s)


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end, "it did not come about"
        time.sleep(0.002)


def test_frames_pass_and_the_lens_is_known_once_it_is_open() -> None:
    inner = Scripted()
    with reconnecting(inner) as camera:
        first, second = camera.read(), camera.read()
        assert camera.camera is CAMERA
        assert camera.state == StreamState("live", "live")
        assert 0 <= time.time_ns() - camera.capture_ns < WAIT_S * 1e9
    assert second.frame_id > first.frame_id
    assert not inner.is_open


@pytest.mark.parametrize("fault", ["fail", "crash", "end"])
def test_after_a_failure_ids_and_times_go_on_rising(fault: str) -> None:
    inner = Scripted({3: fault, 9: fault})
    with reconnecting(inner) as camera:
        frames: list[SensorFrame] = []
        while inner.opened < 3 or len(frames) < 12:
            frames.append(camera.read())
    ids, times = ([getattr(frame, name) for frame in frames] for name in ("frame_id", "timestamp_ns"))
    assert (np.diff(ids) >= 1).all()
    assert (np.diff(times) >= 1).all()
    assert all(frame.depth_timestamp_ns == frame.timestamp_ns + 7 for frame in frames)
    assert inner.opened >= 3
    assert inner.closed >= 2


BLACK, FLAT = np.zeros((6, 8, 3), np.uint8), np.zeros((6, 8), np.float32)


@pytest.mark.parametrize(
    ("color", "depth", "said"),
    [
        (
            FLAT,
            None,
            "colour of test must be an array of uint8 (6, 8, 3), and is float32 (6, 8); correct its",
        ),
        (None, None, "colour of test must be an array of uint8 (6, 8, 3), and is None; correct its driver"),
        (
            BLACK,
            DepthImage(FLAT[1:], FLAT > 0, CAMERA),
            "depth of test must be an array of float32 (6, 8), and",
        ),
        (
            BLACK,
            DepthImage(FLAT, FLAT > 0, cast(Any, 3)),
            "lens of the depth of test is `int`, not a CameraModel",
        ),
        (BLACK, DepthImage(FLAT, FLAT, CAMERA), "mask of depth of test must be an array of bool (6, 8), and"),
    ],
)
def test_frames_that_do_not_fit_their_camera_are_a_fault_of_the_driver(
    color: np.ndarray, depth: DepthImage | None, said: str
) -> None:
    class Wrong(Scripted):
        def read(self) -> SensorFrame:
            return replace(super().read(), color=color, depth=depth)

    with reconnecting(Wrong(), first_wait_s=WAIT_S) as camera:
        wait_for(lambda: camera.state.name == "lost")
        assert said in camera.state.detail


def test_lost_is_said_in_a_sentence_until_it_is_back() -> None:
    inner = Scripted({2: "fail"}, refuse_openings=3)
    with reconnecting(inner, first_wait_s=0.03) as camera:
        states = []

        def seen(name: str) -> bool:
            states.append(camera.state)
            return states[-1].name == name

        wait_for(lambda: seen("lost"))
        assert states[-1].detail == "camera test was unplugged; trying again now"
        wait_for(lambda: camera.state.detail.startswith("camera test is not there"))
        wait_for(lambda: inner.opened == 5)
        wait_for(lambda: seen("live"))
        while camera.read().frame_id < 4:
            pass


def test_waits_double_up_to_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    inner = Scripted({1: "fail"}, refuse_openings=7)
    camera = ReconnectingCamera(inner, "test")
    waits: list[float] = []
    with camera:

        def wait(seconds: float | None = None) -> bool:
            waits.append(seconds or 0)
            return False

        monkeypatch.setattr(camera._closing, "wait", wait)
        wait_for(lambda: inner.opened == 9)
        camera.read()
    assert waits == [0.5, 1, 2, 4, 8, 10, 10, 10]


def test_a_camera_that_stalls_is_opened_again() -> None:
    inner = Scripted({4: "hang"})
    with reconnecting(inner, stall_s=0.1) as camera:
        while inner.opened < 2 or camera.read().frame_id < 8:
            camera.read()
    assert inner.opened == 2


def test_a_stalled_camera_is_stale_and_then_lost() -> None:
    inner = Scripted({2: "hang"})
    with reconnecting(inner, stall_s=0.1, first_wait_s=5.0) as camera:

        def read_on() -> None:
            with suppress(EndOfStream):
                while True:
                    camera.read()

        reader = threading.Thread(target=read_on, daemon=True)
        wait_for(lambda: camera.state.name == "stale")
        assert "no frame for" in camera.state.detail
        with pytest.raises(StaleFrameError, match="no new frame"):
            camera.read_latest(max_age_s=0.05)
        reader.start()  # whoever waits for a frame sees to it that the camera is given up
        wait_for(lambda: camera.state.name == "lost")
        assert "gave no frame for 0.1 s; trying again in 5 s" in camera.state.detail


def test_interrupt_ends_a_read_while_the_camera_is_away() -> None:
    inner = Scripted({1: "fail"})
    with reconnecting(inner, first_wait_s=60) as camera, CaptureThread(camera, keep_all=False) as capture:
        wait_for(lambda: camera.state.name == "lost")
        camera.interrupt()
        wait_for(lambda: capture.take(0.01) is None and capture.ended)
        assert capture.error is None
        with pytest.raises(EndOfStream):
            camera.read()
    assert not inner.is_open


def test_the_first_opening_fails_as_the_camera_does() -> None:
    class Absent(Scripted):
        def open(self) -> None:
            raise CameraFailure("no such camera.")

    with pytest.raises(CameraFailure, match="no such camera"):
        reconnecting(Absent()).open()


def test_a_reader_that_is_late_gets_the_newest_frames_and_sees_the_gap() -> None:
    inner = Scripted()
    with reconnecting(inner) as camera:
        wait_for(lambda: inner.taken > 20)
        late = camera.read().frame_id
        assert late > 10
        newest = camera.read_latest(max_age_s=WAIT_S).frame_id
        assert newest > late
        assert camera.read().frame_id > newest


def test_the_exposure_is_set_between_frames_and_a_refusal_reaches_the_caller() -> None:
    inner = Scripted()
    with reconnecting(inner) as camera:
        camera.set_exposure(0.01)
        assert inner.exposures == [0.01]
        with pytest.raises(DeltalightError, match="too long"):
            camera.set_exposure(2.0)
        camera.read()


def test_the_exposure_of_a_camera_that_is_away_is_not_set() -> None:
    with reconnecting(Scripted({1: "fail"}), stall_s=0.05, first_wait_s=60) as camera:
        wait_for(lambda: camera.state.name == "lost")
        with pytest.raises(DeltalightError, match="away"):
            camera.set_exposure(0.01)


def test_it_can_be_opened_again_after_it_was_closed() -> None:
    camera = reconnecting(Scripted())
    with camera:
        first = camera.read().frame_id
    with camera:
        assert camera.read().frame_id > first


def test_a_driver_that_hangs_keeps_nobody_waiting_and_is_not_opened_twice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Hanging(Scripted):
        released = threading.Event()

        def read(self) -> SensorFrame:
            self.released.wait(WAIT_S)
            raise CameraFailure("time-out of the driver.")

    monkeypatch.setattr("deltalight.sensor_node.cameras.reconnect.CLOSE_S", 0.05)
    inner = Hanging()
    camera = reconnecting(inner)
    camera.open()
    camera.close()
    assert inner.is_open
    with pytest.raises(DeltalightError, match="hangs in its driver"):
        camera.open()
    inner.released.set()
    wait_for(lambda: not inner.is_open)
    inner.released.clear()
    monkeypatch.setattr(Hanging, "read", Scripted.read)
    with camera:
        camera.read()
