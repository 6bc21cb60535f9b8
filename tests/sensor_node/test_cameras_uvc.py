"""UVC cameras: the loop on a real video file through the same OpenCV class, controls against a camera's rules.

No video device is at hand where these run, so that V4L2 itself is not exercised.
"""

import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.sensor_node.cameras.base import EndOfStream, StaleFrameError
from deltalight.sensor_node.cameras.live import CameraFailure, HostClock, LiveCalibration
from deltalight.sensor_node.cameras.settings import CameraSettings
from deltalight.sensor_node.cameras.uvc import UvcCamera, decode
from deltalight.sensor_node.cameras.uvc_controls import AUTOMATIC, MANUAL, UvcControls

WIDTH, HEIGHT, FRAMES = 64, 48, 6


def shade(index: int) -> tuple[int, int, int]:
    """R, G, B of a frame of the video."""
    return 40 * index, 20, 255 - 40 * index


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Motion-JPEG video of frames in plain colours."""
    path = tmp_path_factory.mktemp("uvc") / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (WIDTH, HEIGHT))
    assert writer.isOpened()
    for index in range(FRAMES):
        writer.write(np.full((HEIGHT, WIDTH, 3), shade(index)[::-1], np.uint8))
    writer.release()
    return path


def calibration(width: int = WIDTH, height: int = HEIGHT) -> LiveCalibration:
    matrix = np.array([[60.0, 0, (width - 1) / 2], [0, 60, (height - 1) / 2], [0, 0, 1]])
    ramp = np.repeat(np.linspace(0, 1, 256, dtype=np.float32)[:, None], 3, axis=1)
    return LiveCalibration(camera=CameraModel(width, height, matrix), response=ramp)


def test_a_video_comes_frame_by_frame_until_it_fails_at_its_end(video: Path) -> None:
    known = calibration()
    with UvcCamera(str(video), CameraSettings(), known) as camera:
        frames, stamps = [], []
        for _ in range(FRAMES - 1):
            frames.append(camera.read())
            stamps.append(camera.capture_ns)
        with pytest.raises(CameraFailure, match="plugged in"):
            camera.read()
    # The first picture is spent on looking at its size.
    assert [frame.frame_id for frame in frames] == list(range(FRAMES - 1))
    for index, frame in enumerate(frames, start=1):
        np.testing.assert_allclose(frame.color[24, 32], shade(index), atol=6)
        assert frame.camera == known.camera
        assert frame.response is known.response
        assert frame.exposure_s is None
    assert (np.diff([frame.timestamp_ns for frame in frames]) > 0).all()
    assert abs(stamps[-1] - frames[-1].timestamp_ns) < 1_000_000_000
    assert 0 <= time.time_ns() - stamps[-1] < 60_000_000_000


def test_it_can_be_opened_again_and_counts_on(video: Path) -> None:
    camera = UvcCamera(str(video), CameraSettings(), calibration())
    with camera:
        first = camera.read()
    with pytest.raises(CameraFailure):
        camera.read()
    with camera:
        again = camera.read()
    assert again.frame_id == first.frame_id + 1
    np.testing.assert_array_equal(again.color, first.color)
    assert again.timestamp_ns > first.timestamp_ns


def test_a_picture_of_another_size_than_calibrated_is_refused(video: Path) -> None:
    camera = UvcCamera(str(video), CameraSettings(), calibration(80, 60))
    with pytest.raises(DeltalightError, match="gives 64x48 where 80x60"):
        camera.open()


def test_an_interrupted_read_ends_and_an_old_frame_is_stale(video: Path) -> None:
    with UvcCamera(str(video), CameraSettings(), calibration()) as camera:
        assert camera.read_latest(max_age_s=10).frame_id == 0
        with pytest.raises(StaleFrameError, match="old"):
            camera.read_latest(max_age_s=-1)
        camera.interrupt()
        with pytest.raises(EndOfStream):
            camera.read()


def test_exposures_are_refused_where_their_unit_is_not_known(video: Path) -> None:
    with pytest.raises(DeltalightError, match="exposure"):
        UvcCamera(str(video), CameraSettings(exposure_s=0.01), calibration()).open()
    with (
        UvcCamera(str(video), CameraSettings(), calibration()) as camera,
        pytest.raises(DeltalightError, match=r"0\.02 s"),
    ):
        camera.set_exposure(0.02)


def test_a_jpeg_is_passed_on_as_it_came_without_the_rest_of_the_buffer(video: Path) -> None:
    capture = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    given, packet = capture.read()
    assert given
    whole = packet.tobytes()
    decoded = decode(np.frombuffer(whole + bytes(100), np.uint8)[None], "test")
    assert decoded is not None
    assert decoded[1] == whole
    np.testing.assert_allclose(decoded[0][24, 32], shade(0), atol=6)
    assert decode(np.frombuffer(whole[: len(whole) // 2], np.uint8), "cut") is None
    assert decode(np.frombuffer(b"\xff\xd8\xff\xd9", np.uint8), "empty") is None
    assert decode(np.zeros(0, np.uint8), "nothing") is None


class Controls:
    """The rules of a UVC camera's controls: values that are automatic cannot be set, and are in steps."""

    def __init__(self, *absent: int) -> None:
        self.absent = absent
        self.values = {
            cv2.CAP_PROP_AUTO_EXPOSURE: AUTOMATIC,
            cv2.CAP_PROP_EXPOSURE: 157.0,
            cv2.CAP_PROP_AUTO_WB: 1.0,
            cv2.CAP_PROP_WB_TEMPERATURE: 4600.0,
        }

    def get(self, prop: int, /) -> float:
        return -1.0 if prop in self.absent else self.values[prop]

    def set(self, prop: int, value: float, /) -> bool:
        values, is_automatic = self.values, False
        if prop == cv2.CAP_PROP_EXPOSURE:
            is_automatic = values[cv2.CAP_PROP_AUTO_EXPOSURE] != MANUAL
        if prop == cv2.CAP_PROP_WB_TEMPERATURE:
            is_automatic = values[cv2.CAP_PROP_AUTO_WB] != 0
        if prop in self.absent or is_automatic:
            return False
        values[prop] = value
        return True


def test_a_locked_exposure_is_told_in_the_steps_that_the_camera_takes() -> None:
    device = Controls()
    controls = UvcControls("uvc:0", device, known=True)
    assert controls.exposure_s == pytest.approx(0.0157)
    controls.set_exposure(0.00834)
    assert device.values[cv2.CAP_PROP_EXPOSURE] == 83
    assert controls.exposure_s == pytest.approx(0.0083)
    controls.set_white_balance(5200)
    assert (device.values[cv2.CAP_PROP_AUTO_WB], device.values[cv2.CAP_PROP_WB_TEMPERATURE]) == (0, 5200)
    controls.release()
    assert (device.values[cv2.CAP_PROP_AUTO_EXPOSURE], device.values[cv2.CAP_PROP_AUTO_WB]) == (AUTOMATIC, 1)


def test_what_the_camera_chose_is_kept_and_what_cannot_be_is_said() -> None:
    device = Controls()
    assert UvcControls("uvc:0", device, known=True).keep(exposure=True, white_balance=True) == ""
    assert device.values[cv2.CAP_PROP_AUTO_EXPOSURE] == MANUAL
    assert device.values[cv2.CAP_PROP_EXPOSURE] == 157
    assert (device.values[cv2.CAP_PROP_AUTO_WB], device.values[cv2.CAP_PROP_WB_TEMPERATURE]) == (0, 4600)
    without = UvcControls("uvc:0", Controls(cv2.CAP_PROP_EXPOSURE), known=True)
    assert without.keep(exposure=True, white_balance=True) == "exposure cannot be locked"
    assert without.exposure_s is None
    silent = Controls()
    silent.values[cv2.CAP_PROP_EXPOSURE] = 0
    kept = UvcControls("uvc:0", silent, known=True).keep(exposure=True, white_balance=False)
    assert (kept, silent.values[cv2.CAP_PROP_AUTO_EXPOSURE]) == ("exposure cannot be locked", AUTOMATIC)
    blind = UvcControls("uvc:0", Controls(cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_WB_TEMPERATURE), known=True)
    assert blind.keep(exposure=True, white_balance=True) == "exposure and white balance cannot be locked"


def test_the_drivers_time_counts_if_it_is_of_this_clock() -> None:
    now = 50_000_000_000
    assert HostClock.plausible(now - 20_000_000, now) == now - 20_000_000
    assert HostClock.plausible(1_700_000_000_000_000_000, now) == now  # seconds since 1970
    assert HostClock.plausible(0, now) == now
    clock, moment = HostClock(), time.monotonic_ns()
    assert abs(clock.stamp(moment) - clock.now(moment)) < 50_000_000
