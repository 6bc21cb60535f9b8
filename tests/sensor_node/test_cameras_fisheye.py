"""Fish-eye pictures from any camera: one at a time, as a bracket whose exposures are those of the pictures."""

import threading
import time
from collections import deque
from dataclasses import replace

import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.fisheye_lens import FisheyeCalibration
from deltalight.protocol.frames import FisheyePictures, SensorFrame
from deltalight.sensor_node.cameras.base import Camera, EndOfStream, StreamState
from deltalight.sensor_node.cameras.fisheye_capture import CameraWithFisheye, FisheyeCapture
from deltalight.sensor_node.cameras.reconnect import ReconnectingCamera

SIZE, PERIOD_S, WAIT_S = 16, 0.003, 20.0
LENS = CameraModel(SIZE, SIZE, np.array([[5.0, 0, 7.5], [0, 5, 7.5], [0, 0, 1]]), "equidistant", np.zeros(4))
CALIBRATION = FisheyeCalibration(EquidistantLens(LENS, None))
BRACKET = (0.001, 0.004, 0.016)


def code(exposure_s: float) -> int:
    """Brightness of a picture that the sensor below takes."""
    return round(exposure_s * 10_000)


class Sensor(Camera):
    """A camera whose pictures have a new exposure some frames after it was set; each shows what it had.

    `told`: its frames tell what the sensor did ("measured"), what was asked for ("asked"), or nothing ("no").
    """

    camera = LENS

    def __init__(self, told: str, delay: int = 2, size: int = SIZE) -> None:
        self.exposure_is_measured = told == "measured"
        self.size, self.resumed = size, threading.Event()
        self.resumed.set()
        self._told, self._asked = told, 0.002
        self._pipe = deque([0.002] * delay, maxlen=delay + 1)
        self._number = 0
        self._interrupted = threading.Event()

    def open(self) -> None:
        self._interrupted.clear()

    def close(self) -> None:
        self.interrupt()

    def read(self) -> SensorFrame:
        self.resumed.wait(WAIT_S)
        if self._interrupted.wait(PERIOD_S):
            raise EndOfStream
        self._pipe.append(self._asked)
        exposed_s, self._number = self._pipe[0], self._number + 1
        self._capture_ns = time.time_ns()
        return SensorFrame(
            frame_id=self._number,
            timestamp_ns=self._capture_ns,
            color=np.full((self.size, self.size, 3), code(exposed_s), np.uint8),
            camera=LENS,
            exposure_s={"measured": exposed_s, "asked": self._asked, "no": None}[self._told],
        )

    def read_latest(self, max_age_s: float) -> SensorFrame:  # noqa: ARG002 - always new
        return self.read()

    @property
    def capture_ns(self) -> int:
        return self._capture_ns

    def interrupt(self) -> None:
        self._interrupted.set()

    def set_exposure(self, seconds: float) -> None:
        self._asked = seconds


class Fixed(Sensor):
    """A camera whose exposure cannot be set."""

    set_exposure = Camera.set_exposure


def newest(capture: FisheyeCapture, after: FisheyePictures | None = None) -> FisheyePictures:
    """Waits for pictures that are newer than those given."""
    end = time.monotonic() + WAIT_S
    while (pictures := capture.newest()) is None or pictures is after:
        assert time.monotonic() < end, capture.state
        time.sleep(0.001)
    return pictures


@pytest.mark.parametrize("told", ["measured", "asked", "no"])
@pytest.mark.parametrize("reconnecting", [False, True])
def test_every_picture_of_a_bracket_has_the_exposure_it_is_said_to_have(
    told: str, reconnecting: bool
) -> None:
    sensor: Camera = Sensor(told)
    camera = ReconnectingCamera(sensor, "test", stall_s=WAIT_S) if reconnecting else sensor
    with FisheyeCapture(camera, CALIBRATION, exposures_s=BRACKET, settle_frames=3) as capture:
        first = newest(capture)
        brackets = [first, newest(capture, after=first)]
    for bracket in brackets:
        assert bracket.exposures_s == pytest.approx(BRACKET)
        assert [picture[0, 0, 0] for picture in bracket.pictures] == [code(value) for value in BRACKET]
        assert bracket.calibration is CALIBRATION
    assert brackets[1].timestamp_ns > first.timestamp_ns


def test_without_settling_a_bracket_would_be_wrong() -> None:
    with FisheyeCapture(Sensor("no"), CALIBRATION, exposures_s=BRACKET, settle_frames=0) as capture:
        pictures = newest(capture).pictures
    assert [picture[0, 0, 0] for picture in pictures] != [code(value) for value in BRACKET]


def test_a_camera_that_does_not_follow_tells_what_it_did() -> None:
    with FisheyeCapture(Sensor("measured", delay=1000), CALIBRATION, exposures_s=(0.016,)) as capture:
        pictures = newest(capture)
    assert pictures.exposures_s == (0.002,)


def test_single_pictures_are_taken_as_they_come_and_kept_while_there_are_no_newer_ones() -> None:
    sensor = Sensor("measured")
    with FisheyeCapture(sensor, CALIBRATION) as capture:
        first = newest(capture)
        second = newest(capture, after=first)
        sensor.resumed.clear()
        time.sleep(5 * PERIOD_S)
        last = capture.newest()
        assert capture.newest() is last
        sensor.resumed.set()
    assert first.exposures_s == (0.002,)
    assert second.timestamp_ns > first.timestamp_ns
    assert len(first.pictures) == 1


def test_a_replay_gives_its_own_pictures_the_same_object_while_they_hold() -> None:
    own = FisheyePictures(5, (np.zeros((SIZE, SIZE, 3), np.uint8),) * 2, (0.001, 0.01), CALIBRATION)

    class Replay(Sensor):
        def read(self) -> SensorFrame:
            return replace(super().read(), fisheye=own)

    with FisheyeCapture(Replay("no"), None) as capture:
        assert newest(capture) is own


@pytest.mark.parametrize(
    ("capture", "said"),
    [
        (FisheyeCapture(Sensor("no", size=20), CALIBRATION), "gives 20x20 but its calibration says 16x16"),
        (FisheyeCapture(Sensor("no"), None), "no calibration"),
        (FisheyeCapture(Fixed("no"), CALIBRATION, exposures_s=BRACKET), "exposure cannot be set"),
    ],
)
def test_pictures_that_cannot_be_used_are_named_and_none_is_given(capture: FisheyeCapture, said: str) -> None:
    with capture:
        end = time.monotonic() + WAIT_S
        while capture.state is None and time.monotonic() < end:
            time.sleep(0.001)
        assert capture.state is not None
        assert capture.state.name == "stale"
        assert said in capture.state.detail
        assert capture.newest() is None


def test_frames_of_a_camera_carry_the_newest_pictures_of_another() -> None:
    main, sensor = Sensor("no"), Sensor("measured")
    with CameraWithFisheye(main, FisheyeCapture(sensor, CALIBRATION)) as camera:
        end = time.monotonic() + WAIT_S
        while (frame := camera.read()).fisheye is None:
            assert time.monotonic() < end
        sensor.resumed.clear()
        time.sleep(5 * PERIOD_S)
        held = [camera.read().fisheye for _ in range(3)]
        sensor.resumed.set()
        assert camera.camera is LENS
        assert camera.capture_ns == main.capture_ns
        assert camera.read_latest(1.0).fisheye is not None
    assert held[0] is held[1] is held[2]
    assert held[0] is not None
    assert held[0].timestamp_ns >= frame.fisheye.timestamp_ns
    with pytest.raises(EndOfStream):
        sensor.read()


def test_the_state_is_that_of_whichever_camera_is_not_well() -> None:
    class Told(Sensor):
        def __init__(self, *state: str) -> None:
            super().__init__("no")
            self.said = StreamState(*state) if state else None  # type: ignore[arg-type]

        @property
        def state(self) -> StreamState | None:
            return self.said

    def state(main: Told, fisheye: Told) -> StreamState | None:
        return CameraWithFisheye(main, FisheyeCapture(fisheye, CALIBRATION)).state

    assert state(Told(), Told("live", "live")) is None
    assert state(Told("lost", "gone"), Told("lost", "also gone")) == StreamState("lost", "gone")
    assert state(Told("live", "live"), Told("lost", "unplugged")) == StreamState(
        "stale", "the fish-eye pictures are old: unplugged"
    )


def test_nothing_stays_open_when_the_second_camera_cannot_be_opened() -> None:
    class Absent(Sensor):
        def open(self) -> None:
            raise DeltalightError("no such camera.")

    sensor = Sensor("no")
    with pytest.raises(DeltalightError, match="no such camera"):
        CameraWithFisheye(Absent("no"), FisheyeCapture(sensor, CALIBRATION)).open()
    with pytest.raises(EndOfStream):
        sensor.read()
