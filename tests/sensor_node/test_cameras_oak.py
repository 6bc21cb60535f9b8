"""OAK cameras without an OAK: the SDK's own messages, calibrations and host-only pipelines through our code."""

import threading
import time
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock, call

import cv2
import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.sensor_node.cameras.base import EndOfStream, ImuSample
from deltalight.sensor_node.cameras.live import CameraFailure, LiveCalibration
from deltalight.sensor_node.cameras.oak import OakCamera
from deltalight.sensor_node.cameras.oak_device import OakDevice, OakStreams, _queue
from deltalight.sensor_node.cameras.oak_frames import (
    LONGEST_WAIT_FRAMES,
    Pairing,
    camera_from_calibration,
    camera_from_picture,
    depth_noise_m,
    depth_of,
    exposure_of,
    imu_samples,
    picture_of,
)
from deltalight.sensor_node.cameras.reconnect import ReconnectingCamera
from deltalight.sensor_node.cameras.settings import CameraSettings
from tests.sensor_node.oak_samples import (
    FULL,
    HEIGHT,
    LENS,
    PERIOD_MS,
    SENSOR,
    WAIT_S,
    WIDTH,
    calibration,
    color_message,
    dai,
    depth_message,
    drained,
    imu_message,
)


def test_the_sdk_is_quiet_and_sends_nothing_home(capfd: pytest.CaptureFixture[str]) -> None:
    import os

    assert os.environ["DEPTHAI_TELEMETRY"] == "0"
    assert os.environ["DEPTHAI_AUTOCALIBRATION"] == "OFF", "a station has its own calibration"
    dai.Device.getAllAvailableDevices()
    assert capfd.readouterr().out == ""


def test_a_calibration_becomes_a_camera_of_the_cropped_and_scaled_picture() -> None:
    camera = camera_from_calibration(calibration(), dai.CameraBoardSocket.CAM_A, 1280, 720)
    scale = 1280 / 4056
    assert (camera.width, camera.height, camera.distortion_model) == (1280, 720, "plumb_bob")
    np.testing.assert_allclose(camera.matrix[0, 0], 3000 * scale)
    np.testing.assert_allclose(camera.matrix[0, 2], (2030 + 0.5) * scale - 0.5)
    # 4056x2282 in the middle of 4056x3040: 379 rows above it are cut off.
    np.testing.assert_allclose(camera.matrix[1, 2], (1510 - 379 + 0.5) * 720 / 2282 - 0.5, atol=1e-9)
    np.testing.assert_allclose(camera.distortion, LENS, atol=1e-7)
    full = camera_from_calibration(calibration(), dai.CameraBoardSocket.CAM_A, *FULL)
    np.testing.assert_allclose(full.matrix, SENSOR)


def test_the_lens_model_is_the_one_of_opencv_with_the_same_order() -> None:
    camera = camera_from_calibration(calibration(), dai.CameraBoardSocket.CAM_A, *FULL)
    points = np.array([[0.3, -0.2, 1.0], [-0.5, 0.35, 1.2]])
    picture = dai.ImgTransformation(*FULL, SENSOR, dai.CameraModel.Perspective, LENS)
    theirs = [picture.project3DPoint(dai.Point3f(*point)) for point in points]
    np.testing.assert_allclose(camera.project(points), [[point.x, point.y] for point in theirs], atol=0.02)


def test_a_fisheye_calibration_and_a_missing_one() -> None:
    handler, socket = calibration(), dai.CameraBoardSocket.CAM_D
    with pytest.raises(DeltalightError, match="no calibration of CAM_D"):
        camera_from_calibration(handler, socket, 640, 480)
    handler.setCameraIntrinsics(socket, [[400.0, 0, 640], [0, 400, 480], [0, 0, 1]], dai.Size2f(1280, 960))
    handler.setDistortionCoefficients(socket, [0.1, -0.02, 0.003, 0.0])
    handler.setCameraType(socket, dai.CameraModel.Fisheye)
    camera = camera_from_calibration(handler, socket, 640, 480)
    assert camera.distortion_model == "equidistant"
    np.testing.assert_allclose(camera.distortion, [0.1, -0.02, 0.003, 0.0], atol=1e-7)
    handler.setCameraType(socket, dai.CameraModel.Cylindrical)
    with pytest.raises(DeltalightError, match="Cylindrical"):
        camera_from_calibration(handler, socket, 640, 480)


def test_a_calibration_written_and_read_as_eeprom_json_is_the_same(tmp_path: Path) -> None:
    calibration().eepromToJsonFile(tmp_path / "eeprom.json")
    again = dai.CalibrationHandler(tmp_path / "eeprom.json")
    socket = dai.CameraBoardSocket.CAM_A
    assert camera_from_calibration(again, socket, 1280, 720) == camera_from_calibration(
        calibration(), socket, 1280, 720
    )


def test_a_picture_tells_its_own_camera() -> None:
    raw = camera_from_picture(color_message(0, 0), corrected=False)
    corrected = camera_from_picture(color_message(0, 0), corrected=True)
    assert raw is not None
    assert corrected is not None
    np.testing.assert_allclose(raw.distortion, LENS, atol=1e-7)
    assert not corrected.has_distortion
    np.testing.assert_allclose(corrected.matrix[0, 0], 3000 * WIDTH / 4056, rtol=1e-5)
    assert camera_from_picture(dai.ImgFrame(), corrected=False) is None


def test_depth_noise_follows_from_baseline_and_focal_length() -> None:
    sockets = dai.CameraBoardSocket
    noise = depth_noise_m(calibration(), sockets.CAM_B, sockets.CAM_C, (640, 400))
    assert noise == pytest.approx(0.125 / (400 * 0.075), rel=1e-5)
    assert depth_noise_m(dai.CalibrationHandler(), sockets.CAM_B, sockets.CAM_C, (640, 400)) is None


def test_pictures_come_out_in_rgb_from_whatever_the_device_sends() -> None:
    red = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    red[..., 0] = 200
    plain = dai.ImgFrame()
    plain.setType(dai.ImgFrame.Type.RGB888i).setSize(WIDTH, HEIGHT)
    plain.setFrame(red)
    np.testing.assert_array_equal(picture_of(plain, "test")[0], red)
    nv12 = dai.ImgFrame()
    nv12.setCvFrame(red[..., ::-1].copy(), dai.ImgFrame.Type.NV12)
    np.testing.assert_allclose(picture_of(nv12, "test")[0], red, atol=8)
    encoded, data = dai.EncodedFrame(), cv2.imencode(".jpg", red[..., ::-1])[1].tobytes()
    encoded.setData(data)
    color, jpeg = picture_of(encoded, "test")
    assert jpeg == data
    np.testing.assert_allclose(color, red, atol=8)


def test_depth_is_in_metres_with_zero_unknown_and_may_be_smaller_than_colour() -> None:
    camera = CameraModel(WIDTH, HEIGHT, np.array([[40.0, 0, 31.5], [0, 40, 17.5], [0, 0, 1]]))
    depth = depth_of(depth_message(234, 0), camera, 0.004)
    assert depth.depth_m[5, 5] == pytest.approx(1.234)
    assert (depth.valid[0, 0], depth.depth_m[0, 0], depth.valid[0, 1]) == (False, 0, True)
    assert (depth.camera, depth.noise_sigma_m) == (camera, 0.004)
    half = depth_of(depth_message(0, 0, (WIDTH // 2, HEIGHT // 2)), camera, None)
    assert half.camera == camera.resized(WIDTH // 2, HEIGHT // 2)


def test_exposure_and_imu_are_told_in_si_units() -> None:
    assert exposure_of(color_message(0, 0, exposure_us=12_345)) == pytest.approx(0.012345)
    assert exposure_of(dai.ImgFrame()) is None
    (sample,) = imu_samples(imu_message(), lambda ns: ns + 7)
    np.testing.assert_allclose(sample.acceleration_m_s2, [0.1, -9.8, 0.2], rtol=1e-6)
    np.testing.assert_allclose(sample.angular_rate_rad_s, [0, 0, 1.5], rtol=1e-6)
    assert sample.timestamp_ns == 7


def test_depth_that_comes_late_is_paired_by_its_time() -> None:
    pairing = Pairing(tolerance_ns=16_000_000)
    for number in range(3):
        pairing.add_picture(color_message(number, 33 * number))
    assert drained(pairing) == []
    pairing.add_depth(depth_message(10, 0.4))
    pairing.add_depth(depth_message(11, 33.4))
    assert drained(pairing) == [(0, 10), (1, 11)]
    pairing.add_depth(depth_message(12, 67))
    assert drained(pairing) == [(2, 12)]
    assert pairing.unpaired == 0


def test_a_picture_whose_depth_was_lost_goes_on_without_it() -> None:
    pairing = Pairing(tolerance_ns=16_000_000)
    for number in range(2):
        pairing.add_picture(color_message(number, 33 * number))
    pairing.add_depth(depth_message(11, 33))
    assert drained(pairing) == [(0, None), (1, 11)]
    for number in range(2, 2 + LONGEST_WAIT_FRAMES + 2):
        pairing.add_picture(color_message(number, 33 * number))
    assert drained(pairing) == [(2, None), (3, None)]
    assert pairing.unpaired == 3


class HostOnlyDevice(OakDevice):
    """The seam without hardware: the SDK's pipeline and queues, fed by a node on this host."""

    def __init__(self, *, depth: bool = True, frames: int = 1_000_000) -> None:
        super().__init__("test")
        self.openings = 0
        self.sent: list[Any] = []  # of the SDK's kind
        self._depth, self._frames = depth, frames
        self._source: Any = None

    def open(
        self,
        settings: CameraSettings,  # noqa: ARG002 - for the hardware
        size: tuple[int, int],
        *,
        with_depth: bool,
    ) -> OakStreams:
        self.openings += 1
        assert size == (WIDTH, HEIGHT)
        self._pipeline = dai.Pipeline(createImplicitDevice=False)
        self._source = self._pipeline.create(_source_node(), self._frames)
        sockets = dai.CameraBoardSocket
        streams = OakStreams(_queue(self._source.color), calibration(), sockets.CAM_A, corrected=with_depth)
        if with_depth:
            streams.depth, streams.stereo_sockets = _queue(self._source.depth), (sockets.CAM_B, sockets.CAM_C)
            streams.imu = _queue(self._source.imu)
        self._pipeline.start()
        return streams

    @property
    def is_running(self) -> bool:
        return self._pipeline is not None and not self._source.is_done

    def send(self, control: Any) -> None:  # noqa: ANN401
        self.sent.append(control)
        if control.getExposureTime() > timedelta():
            exposure_us = round(control.getExposureTime() / timedelta(microseconds=1))
            self._source.exposure = exposure_us, control.getSensitivity()


def _source_node() -> Any:  # noqa: ANN401 - a class of the SDK's kind
    class Source(dai.node.ThreadedHostNode):  # type: ignore[misc]
        def __init__(self, frames: int) -> None:
            dai.node.ThreadedHostNode.__init__(self)
            self.color, self.depth, self.imu = (self.createOutput() for _ in range(3))
            self.frames, self.is_done, self.exposure = frames, False, (8000, 400)

        def run(self) -> None:
            for number in range(self.frames):
                if not self.isRunning():
                    break
                now_ms = dai.Clock.now() / timedelta(milliseconds=1)
                self.color.send(color_message(number, now_ms, *self.exposure))
                # Every fourth depth image is lost.
                if number % 4 != 3:
                    self.depth.send(depth_message(number, now_ms + 0.3))
                self.imu.send(imu_message())
                time.sleep(PERIOD_MS / 1000)
            self.is_done = True

    return Source


SETTINGS = CameraSettings(width=WIDTH, height=HEIGHT, fps=1000 / PERIOD_MS, lock=False)


@pytest.fixture
def oak() -> Iterator[Callable[..., OakCamera]]:
    """Makes OAK cameras that are closed at the end: a pipeline left running ends the process badly."""
    made = []

    def make(device: HostOnlyDevice, settings: CameraSettings = SETTINGS, **options: Any) -> OakCamera:  # noqa: ANN401
        made.append(
            OakCamera("", settings, options.pop("known", LiveCalibration()), device=device, **options)
        )
        return made[-1]

    yield make
    for camera in made:
        camera.close()


def read_on(camera: OakCamera) -> None:
    while True:
        camera.read()


def test_frames_come_with_depth_pose_free_and_on_this_hosts_clock(oak: Callable[..., OakCamera]) -> None:
    before_ns = time.time_ns()
    camera = oak(HostOnlyDevice())
    with camera:
        frames = [camera.read() for _ in range(12)]
        age_ns = time.time_ns() - camera.capture_ns
    assert 0 <= age_ns < WAIT_S * 1e9
    assert all(before_ns <= frame.timestamp_ns <= time.time_ns() for frame in frames)
    assert (np.diff([frame.frame_id for frame in frames]) > 0).all()
    np.testing.assert_allclose(camera.camera.matrix[0, 0], 3000 * WIDTH / 4056, rtol=1e-5)
    assert not camera.camera.has_distortion
    assert camera.depth_scale == 0.001
    for frame in frames:
        assert frame.color[0, 0, 0] == frame.frame_id % 200
        assert frame.exposure_s == pytest.approx(0.008)
        assert (frame.depth is None) == (frame.frame_id % 4 == 3)
        if frame.depth is not None and frame.depth_timestamp_ns is not None:
            assert frame.depth.depth_m[5, 5] == pytest.approx((1000 + frame.frame_id) / 1000)
            assert 200_000 <= frame.depth_timestamp_ns - frame.timestamp_ns <= 400_000
            assert frame.depth.noise_sigma_m == pytest.approx(0.125 / 30, rel=1e-5)
    assert camera.unpaired > 0


def test_colour_alone_comes_as_the_sensor_sees_it(oak: Callable[..., OakCamera]) -> None:
    with oak(HostOnlyDevice(), with_depth=False) as camera:
        frames = [camera.read() for _ in range(3)]
        assert camera.imu_samples() == []
    assert all(frame.depth is None for frame in frames)
    assert camera.depth_scale is None
    np.testing.assert_allclose(camera.camera.distortion, LENS, atol=1e-7)


def test_rgb_yaml_goes_before_the_devices_own_calibration(oak: Callable[..., OakCamera]) -> None:
    own = CameraModel(WIDTH, HEIGHT, np.array([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]]))
    with oak(HostOnlyDevice(), known=LiveCalibration(camera=own, depth_noise_m=0.01)) as camera:
        frame = next(frame for frame in iter(camera.read, None) if frame.depth is not None)
    assert frame.camera == own
    assert frame.depth is not None
    assert frame.depth.noise_sigma_m == 0.01


def test_an_rgb_yaml_with_distortion_does_not_fit_corrected_pictures(oak: Callable[..., OakCamera]) -> None:
    matrix = np.array([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]])
    known = LiveCalibration(
        camera=CameraModel(WIDTH, HEIGHT, matrix, "plumb_bob", np.array([0.1, 0, 0, 0, 0]))
    )
    with pytest.raises(DeltalightError, match=r"take rgb\.yaml out"):
        oak(HostOnlyDevice(), known=known).open()
    with oak(HostOnlyDevice(), known=known, with_depth=False) as camera:
        assert camera.read().camera == known.camera


def test_the_sdk_has_what_the_device_is_driven_with() -> None:
    """The pipeline of a device cannot be built without one; at least its words must be the SDK's."""
    node, control = dai.node, dai.CameraControl
    used = {
        dai.DeviceBase: "close getConnectedCameras getConnectedIMU getPlatform getUsbSpeed isClosed readCalibration"
        " setMaxReconnectionAttempts",
        node.Camera: "build initialControl inputControl requestOutput",
        node.StereoDepth: "build depth initialConfig inputAlignTo setLeftRightCheck setSubpixel"
        " setSubpixelFractionalBits",
        node.NeuralDepth: "build depth initialConfig",
        dai.DeviceModelZoo: "NEURAL_DEPTH_NANO NEURAL_DEPTH_SMALL NEURAL_DEPTH_MEDIUM NEURAL_DEPTH_LARGE",
        node.ImageAlign: "input inputAlignTo outputAligned",
        node.VideoEncoder: "build out",
        node.IMU: "enableIMUSensor out setBatchReportThreshold setMaxBatchReports",
        control: "setAutoExposureLock setAutoWhiteBalanceLock setManualExposure setManualFocus"
        " setManualWhiteBalance",
        dai.IMUSensor: "ACCELEROMETER_RAW GYROSCOPE_RAW",
        dai.Platform: "RVC4",
        dai.UsbSpeed: "SUPER SUPER_PLUS",
        dai.VideoEncoderProperties.Profile: "MJPEG",
    }
    missing = [
        (owner, name) for owner, names in used.items() for name in names.split() if not hasattr(owner, name)
    ]
    assert missing == []
    config = dai.StereoDepthConfig()
    assert config.getDepthUnit().name == "MILLIMETER"
    config.postProcessing.temporalFilter.enable = True
    assert config.postProcessing.temporalFilter.enable


class Wired(OakDevice):
    """A device whose nodes note how they are wired; each knows no other words than the SDK's node of its kind."""

    def __init__(self, platform: object) -> None:
        super().__init__("test")
        self.nodes: dict[str, list[Any]] = {}
        self._device = MagicMock(spec=dai.Device)
        self._device.getPlatform.return_value = platform
        sockets = dai.CameraBoardSocket
        self._device.getConnectedCameras.return_value = [sockets.CAM_A, sockets.CAM_B, sockets.CAM_C]
        self._device.getConnectedIMU.return_value = "NONE"
        self._device.getUsbSpeed.return_value = dai.UsbSpeed.SUPER
        self._device.readCalibration.return_value = calibration()
        self._pipeline = MagicMock(spec=dai.Pipeline)
        self._pipeline.create.side_effect = self._create

    def _create(self, kind: type) -> MagicMock:
        made = MagicMock(spec=kind)
        if hasattr(kind, "build"):
            made.build.return_value = made
        self.nodes.setdefault(kind.__name__, []).append(made)
        return made

    def build(self, settings: CameraSettings) -> OakStreams:
        return self._build(dai, settings, (WIDTH, HEIGHT), with_depth=True)


@pytest.mark.parametrize("size", ["nano", "small", "medium", "large"])
def test_neural_depth_takes_the_place_of_stereo_and_is_aligned(size: str) -> None:
    device = Wired(dai.Platform.RVC4)
    streams = device.build(SETTINGS.replaced(neural_depth=size))
    assert "StereoDepth" not in device.nodes
    (network,), (align,) = device.nodes["NeuralDepth"], device.nodes["ImageAlign"]
    color, left, right = device.nodes["Camera"]
    for camera in (left, right):
        camera.requestFullResolutionOutput.assert_called_once_with(fps=SETTINGS.fps)
    model = getattr(dai.DeviceModelZoo, f"NEURAL_DEPTH_{size.upper()}")
    given = (left.requestFullResolutionOutput.return_value, right.requestFullResolutionOutput.return_value)
    network.build.assert_called_once_with(*given, model)
    network.depth.link.assert_called_once_with(align.input)
    color.requestOutput.return_value.link.assert_called_once_with(align.inputAlignTo)
    assert streams.depth is align.outputAligned.createOutputQueue.return_value
    assert streams.stereo_sockets is None, "its noise is not that of stereo matching"
    assert dai.NeuralDepthConfig().getDepthUnit().name == "MILLIMETER"


def test_without_a_network_stereo_matches_as_before() -> None:
    for platform, is_aligned in ((dai.Platform.RVC4, True), (dai.Platform.RVC2, False)):
        device = Wired(platform)
        streams = device.build(SETTINGS)
        assert "NeuralDepth" not in device.nodes
        assert ("ImageAlign" in device.nodes) is is_aligned
        assert device.nodes["StereoDepth"][0].setSubpixel.call_args == call(True)
        assert streams.stereo_sockets == (dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C)


def test_neural_depth_needs_an_oak_4() -> None:
    with pytest.raises(DeltalightError, match="needs an OAK 4"):
        Wired(dai.Platform.RVC2).build(SETTINGS.replaced(neural_depth="small"))


def test_exposure_is_locked_as_set_or_as_it_came_to_rest(oak: Callable[..., OakCamera]) -> None:
    device = HostOnlyDevice()
    with oak(device, SETTINGS.replaced(exposure_s=0.004)) as camera:
        assert camera.exposure_is_measured
        while camera.read().exposure_s != pytest.approx(0.004):
            pass
        assert device.sent[0].getSensitivity() == 100
        camera.set_exposure(0.001)
        while camera.read().exposure_s != pytest.approx(0.001):
            pass
    resting = HostOnlyDevice()
    with oak(resting, SETTINGS.replaced(lock=True)) as camera:
        (control,) = resting.sent
        assert (control.aeLockMode, control.awbLockMode) == (True, True)
        camera.read()
        camera.set_exposure(0.001)
        assert resting.sent[-1].getSensitivity() == 400  # as in the picture


def test_a_device_that_goes_away_is_a_failure_and_comes_back(oak: Callable[..., OakCamera]) -> None:
    device = HostOnlyDevice(frames=12)
    with oak(device) as camera, pytest.raises(CameraFailure, match="unplugged"):
        read_on(camera)
    with ReconnectingCamera(camera, "oak", stall_s=WAIT_S, first_wait_s=0.01) as again:
        frames = [again.read() for _ in range(25)]
        samples: list[ImuSample] = []
        while not samples:
            samples = again.imu_samples()
    assert samples[0].acceleration_m_s2[1] == pytest.approx(-9.8)
    assert device.openings > 2
    assert (np.diff([frame.frame_id for frame in frames]) > 0).all()


def test_interrupt_ends_a_waiting_read(oak: Callable[..., OakCamera]) -> None:
    device = HostOnlyDevice(frames=1)
    with oak(device) as camera:
        device._source.is_done = False
        timer = threading.Timer(0.05, camera.interrupt)
        timer.start()
        with pytest.raises(EndOfStream):
            read_on(camera)
        timer.join()


def test_without_a_device_it_is_said_what_to_do() -> None:
    if dai.Device.getAllAvailableDevices():
        pytest.skip("an OAK is plugged in")
    with (
        pytest.raises(CameraFailure, match="deltalight doctor"),
        OakCamera("", CameraSettings(), LiveCalibration()),
    ):
        pass
