"""What users write as a source: cameras, folders, recordings, and what is said of anything else."""

import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel, save_camera_yaml
from deltalight.protocol.dataset_writer import DatasetWriter
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.fisheye_lens import FisheyeCalibration, save_fisheye_yaml
from deltalight.sensor_node.cameras import rgbd
from deltalight.sensor_node.cameras.live import LiveCalibration, load_calibration
from deltalight.sensor_node.cameras.open import is_live, open_camera, open_fisheye
from deltalight.sensor_node.cameras.reconnect import ReconnectingCamera
from deltalight.sensor_node.cameras.replay import ReplayCamera
from deltalight.sensor_node.cameras.settings import CameraSettings, FisheyeSettings
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera, default_board

WAIT_S = 20.0


def write_video(path: Path, width: int, height: int, frames: int) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (width, height))
    for index in range(frames):
        writer.write(np.full((height, width, 3), 10 * index, np.uint8))
    writer.release()


def pinhole(width: int = 64, height: int = 48) -> CameraModel:
    matrix = np.array([[60.0, 0, (width - 1) / 2], [0, 60, (height - 1) / 2], [0, 0, 1]])
    return CameraModel(width, height, matrix)


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    """A calibration folder of a 64x48 camera."""
    folder = tmp_path / "station"
    folder.mkdir()
    save_camera_yaml(folder / "rgb.yaml", pinhole(), "rgb")
    return folder


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("uvd:1", "`uvc:1`"),
        ("okk", "`oak`"),
        ("orbec:0", "`orbbec:0`"),
        ("sintetic", "`synthetic`"),
        ("xq", "`uvc:0`"),
        ("nowhere/take", "does not exist"),
        ("take.mcap", "does not exist"),
        ("TAKE.MCAP", "does not exist"),
        ("openni2:left", "number"),
    ],
)
def test_an_unknown_source_is_answered_by_the_nearest(source: str, said: str) -> None:
    with pytest.raises(DeltalightError, match=said) as caught:
        open_camera(source)
    assert len(str(caught.value).splitlines()) == 1


def test_a_folder_and_the_synthetic_scene_are_replayed_and_never_reconnected(tmp_path: Path) -> None:
    camera = SyntheticCamera()
    with DatasetWriter(tmp_path / "take", board=camera.board) as writer:
        writer.add(camera.frame_at(0))
    replayed = open_camera(str(tmp_path / "take"), CameraSettings(realtime=False, loop=False))
    assert isinstance(replayed, ReplayCamera)
    with replayed:
        assert replayed.read().frame_id == 0
    assert isinstance(open_camera("synthetic"), SyntheticCamera)
    assert [is_live(source) for source in ("uvc:0", "oak", "synthetic", "uvcs/take")] == [
        True,
        True,
        False,
        False,
    ]


def test_the_synthetic_camera_has_the_size_and_rate_of_its_settings() -> None:
    small = CameraSettings(width=64, height=48, fps=10, realtime=False)
    with open_camera("synthetic", small) as camera:
        first, second = camera.read(), camera.read()
    assert first.color.shape == (48, 64, 3)
    assert first.depth is not None
    assert first.depth.depth_m.shape == (48, 64)
    assert second.timestamp_ns - first.timestamp_ns == 100_000_000
    assert open_camera("synthetic").camera.width == 640


def test_a_board_given_by_the_caller_goes_before_the_one_of_the_source(calibration: Path) -> None:
    board = default_board().replaced(rows=7)
    assert open_camera("synthetic", board=board).board == board
    assert open_camera("uvc:0", CameraSettings(calibration=calibration), board=board).board == board


def test_a_live_camera_needs_its_calibration(calibration: Path) -> None:
    with pytest.raises(DeltalightError, match="deltalight calibrate camera"):
        open_camera("uvc:0")
    known = open_camera("uvc:0", CameraSettings(calibration=calibration))
    assert isinstance(known, ReconnectingCamera)
    assert known.camera == pinhole()
    nominal = open_camera("uvc:0", CameraSettings(width=640, height=480), calibrated=False).camera
    assert (nominal.width, nominal.height, nominal.matrix[0, 2]) == (640, 480, 319.5)


def test_a_size_of_the_same_shape_scales_the_calibration_and_another_is_refused(calibration: Path) -> None:
    twice = open_camera("uvc:0", CameraSettings(calibration=calibration, width=128, height=96)).camera
    assert twice == pinhole().resized(128, 96)
    with pytest.raises(DeltalightError, match="not a scaled copy"):
        open_camera("uvc:0", CameraSettings(calibration=calibration, width=128, height=72))


def test_a_device_that_is_not_there_is_said_when_it_is_opened(calibration: Path) -> None:
    with (
        pytest.raises(DeltalightError, match="there is no /dev/video987"),
        open_camera("uvc:987", CameraSettings(calibration=calibration)),
    ):
        pass


def test_a_calibration_folder_may_be_a_dataset_folder(tmp_path: Path, calibration: Path) -> None:
    place = tmp_path / "take"
    (place / "calibration").mkdir(parents=True)
    save_camera_yaml(place / "calibration" / "rgb.yaml", pinhole(), "rgb")
    (place / "calibration" / "depth.yaml").write_text("depth_scale: 0.00025\nnoise_sigma_m: 0.002\n")
    ramp = np.repeat(np.linspace(0, 1, 256)[:, None], 3, axis=1)
    np.savetxt(place / "response.txt", ramp)
    known = load_calibration(place)
    assert (known.camera, known.depth_camera) == (pinhole(), None)
    assert (known.depth_scale, known.depth_noise_m) == (0.00025, 0.002)
    assert known.response is not None
    np.testing.assert_allclose(known.response, ramp, atol=1e-6)
    assert load_calibration(calibration).response is None
    (calibration / "depth.yaml").write_text("depth_scale: -1\n")
    with pytest.raises(DeltalightError, match="depth_scale"):
        load_calibration(calibration)
    with pytest.raises(DeltalightError, match="does not exist"):
        load_calibration(tmp_path / "nowhere")


def test_a_fisheye_source_needs_fisheye_yaml_unless_a_replay_brings_its_own(calibration: Path) -> None:
    settings = FisheyeSettings(source="uvc:2", camera=CameraSettings(calibration=calibration))
    with pytest.raises(DeltalightError, match="calibrate fisheye"):
        open_fisheye(settings)
    matrix = np.array([[20.0, 0, 31.5], [0, 20, 31.5], [0, 0, 1]])
    lens = EquidistantLens(CameraModel(64, 64, matrix, "equidistant", np.zeros(4)), None)
    save_fisheye_yaml(calibration / "fisheye.yaml", FisheyeCalibration(lens))
    assert open_fisheye(settings).newest() is None
    assert open_fisheye(FisheyeSettings(source="uvc:2"), calibration).newest() is None
    assert open_fisheye(FisheyeSettings(source="synthetic")).newest() is None


def test_a_fisheye_camera_captures_at_the_size_of_its_lens(calibration: Path, tmp_path: Path) -> None:
    matrix = np.array([[20.0, 0, 15.5], [0, 20, 15.5], [0, 0, 1]])
    lens = EquidistantLens(CameraModel(32, 32, matrix, "equidistant", np.zeros(4)), None)
    # In the same folder as the rgb.yaml of another camera, of another size.
    save_fisheye_yaml(calibration / "fisheye.yaml", FisheyeCalibration(lens))
    write_video(tmp_path / "sky.avi", 32, 32, frames=20)
    settings = FisheyeSettings(source=f"uvc:{tmp_path / 'sky.avi'}")
    with open_fisheye(settings, calibration) as capture:
        end = time.monotonic() + WAIT_S
        while (pictures := capture.newest()) is None:
            assert time.monotonic() < end, capture.state
            time.sleep(0.002)
    assert pictures.pictures[0].shape == (32, 32, 3)
    assert (pictures.calibration.lens.width, pictures.calibration.lens.height) == (32, 32)


def test_a_live_camera_goes_on_over_the_end_of_its_stream(calibration: Path, tmp_path: Path) -> None:
    write_video(tmp_path / "take.avi", 64, 48, frames=6)
    with open_camera(f"uvc:{tmp_path / 'take.avi'}", CameraSettings(calibration=calibration)) as camera:
        frames = [camera.read() for _ in range(2)]
        while frames[-1].frame_id < 7:
            frames.append(camera.read())
    assert (np.diff([frame.frame_id for frame in frames]) > 0).all()
    assert (np.diff([frame.timestamp_ns for frame in frames]) > 0).all()


def test_rgbd_cameras_say_what_this_opencv_lacks(calibration: Path) -> None:
    from deltalight.sensor_node.cameras.rgbd import has_backend

    if has_backend("openni2"):
        pytest.skip("this OpenCV reads OpenNI 2 cameras")
    with pytest.raises(DeltalightError, match="WITH_OPENNI2=ON"):
        open_camera("openni2:0", CameraSettings(calibration=calibration))


def test_colour_and_depth_of_an_rgbd_camera_become_one_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """What OpenCV gives (BGR, 16-bit mm), without the backend that the packages lack."""
    monkeypatch.setattr(rgbd, "has_backend", lambda _: True)
    bgr, steps = np.zeros((48, 64, 3), np.uint8), np.full((48, 64), 750, np.uint16)
    bgr[..., 0], steps[3, 4] = 200, 0
    known = LiveCalibration(camera=pinhole(), depth_noise_m=0.003)
    frame = rgbd.RgbdCamera("orbbec", 0, CameraSettings(), known)._frame(bgr, steps)
    assert frame.color[0, 0].tolist() == [0, 0, 200]
    assert frame.depth is not None
    assert (frame.depth.camera, frame.depth.noise_sigma_m) == (pinhole(), 0.003)
    assert frame.depth.depth_m[0, 0] == pytest.approx(0.75)
    assert not frame.depth.valid[3, 4]
    assert frame.depth_timestamp_ns == frame.timestamp_ns
    apart = LiveCalibration(camera=pinhole(), depth_camera=pinhole(80, 60), depth_scale=0.0001)
    unregistered = rgbd.RgbdCamera("openni2", 0, CameraSettings(), apart)._frame(bgr, steps)
    assert unregistered.depth is not None
    assert unregistered.depth.camera == pinhole(80, 60)
    assert unregistered.depth.depth_m[0, 0] == pytest.approx(0.075)
    assert rgbd.RgbdCamera("orbbec", 0, CameraSettings(), known)._frame(bgr, None).depth is None
    with pytest.raises(DeltalightError, match="gives 32x24"):
        rgbd.RgbdCamera("orbbec", 0, CameraSettings(), known)._frame(bgr[:24, :32], None)
    with pytest.raises(DeltalightError, match="no exposure"):
        rgbd.RgbdCamera("orbbec", 0, CameraSettings(exposure_s=0.01), known)
