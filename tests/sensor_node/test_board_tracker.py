"""Following a board through a camera's pictures: as exact as detection, at rest, in motion, and behind a hand."""

from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest
from jaxtyping import Float64, UInt8

from deltalight.protocol.frames import BoardPose
from deltalight.sensor_node.board_tracker import MOST_REUSED, BoardTracker
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera, SyntheticNoise, default_camera
from deltalight.sensor_node.markers import BoardDetector
from deltalight.sensor_node.resting_board import REST_PX, RestingBoard

Picture = UInt8[np.ndarray, "h w 3"]
NOISE_CODES = 1.5
# What detections of one board differ by, for the noise alone, at its corners.
DETECTION_PX = 0.03


class Counted(BoardDetector):
    """A detector that counts what it is asked for."""

    whole = parts = 0

    def detect(self, color: Picture, region: tuple[slice, slice] | None = None) -> BoardPose | None:
        self.whole += region is None
        self.parts += region is not None
        return super().detect(color, region)


@pytest.fixture(scope="module")
def camera() -> SyntheticCamera:
    return SyntheticCamera(camera=default_camera().resized(320, 240), noise=SyntheticNoise())


@pytest.fixture(scope="module")
def still(camera: SyntheticCamera) -> Picture:
    """A picture without noise."""
    return SyntheticCamera(camera.board, camera.camera).frame_at(0).color


@pytest.fixture
def detector(camera: SyntheticCamera) -> Counted:
    assert camera.board is not None
    return Counted(camera.board, camera.camera)


@pytest.fixture
def tracker(detector: Counted) -> BoardTracker:
    return BoardTracker(detector)


@pytest.fixture
def misses_px(camera: SyntheticCamera, tracker: BoardTracker) -> Callable[[Picture], float]:
    """Returns how far the tracker places a corner from where a detection of the same picture does, at most."""
    assert camera.board is not None
    alone = BoardDetector(camera.board, camera.camera)

    def missed(color: Picture) -> float:
        found, truth = tracker.detect(color), alone.detect(color)
        assert found is not None
        assert truth is not None
        places = [alone.corners_at(pose.world_from_camera) for pose in (found, truth)]
        return float(np.linalg.norm(places[0] - places[1], axis=1).max())

    return missed


def noisy(picture: Picture, seed: int) -> Picture:
    noise = np.random.default_rng(seed).normal(0, NOISE_CODES, picture.shape)
    return np.clip(np.rint(picture + noise), 0, 255).astype(np.uint8)


def shifted(picture: Picture, x_px: float, y_px: float = 0.0) -> Picture:
    """Returns the picture moved by fractions of a pixel, exactly: by the Fourier transform."""
    rows, columns = (np.fft.fftfreq(size)[:, None] for size in picture.shape[:2])
    turn = np.exp(-2j * np.pi * (rows * y_px + columns.T * x_px))[..., None]
    moved = np.fft.ifft2(np.fft.fft2(picture, axes=(0, 1)) * turn, axes=(0, 1)).real
    return np.clip(np.rint(moved), 0, 255).astype(np.uint8)


def test_a_resting_board_is_searched_once_in_a_while_and_keeps_its_pose(
    still: Picture, detector: Counted, misses_px: Callable[[Picture], float]
) -> None:
    misses = [misses_px(noisy(still, seed)) for seed in range(MOST_REUSED + 2)]
    assert (detector.whole, detector.parts) == (1, 1)
    assert max(misses) < DETECTION_PX


@pytest.mark.parametrize("step_px", [0.01, 0.1])
def test_slow_motion_is_followed_without_lag(
    still: Picture, misses_px: Callable[[Picture], float], step_px: float
) -> None:
    """Steps far below a pixel add up against the last picture that was searched, so none is missed."""
    misses = [misses_px(noisy(shifted(still, step_px * step), step)) for step in range(60)]
    assert max(misses) < REST_PX + DETECTION_PX
    if step_px > REST_PX:
        assert max(misses) < DETECTION_PX


def test_a_moving_camera_gives_the_poses_of_detection(
    camera: SyntheticCamera, detector: Counted, misses_px: Callable[[Picture], float]
) -> None:
    """Pictures of the circling camera; each is searched where the board was before, not as a whole."""
    assert max(misses_px(camera.frame_at(index).color) for index in range(8)) < 1e-3
    assert detector.whole == 1


def test_a_jump_is_followed_at_once(still: Picture, misses_px: Callable[[Picture], float]) -> None:
    assert misses_px(noisy(still, 0)) < 1e-3
    assert misses_px(noisy(shifted(still, 70, 20), 1)) < DETECTION_PX
    assert misses_px(noisy(shifted(still, -60, -15), 2)) < DETECTION_PX


def test_a_jump_by_one_marker_is_no_rest(
    camera: SyntheticCamera, still: Picture, misses_px: Callable[[Picture], float]
) -> None:
    """Outlines of the markers then lie on outlines, and only their bits tell."""
    assert camera.board is not None
    pose = camera.pose_at(0)
    pitch = np.array([camera.board.marker_length_m + camera.board.separation_m, 0, 0])
    corners = camera.board.corner_points()[5]
    seen = [
        camera.camera.project((corners + step - pose[:3, 3]) @ pose[:3, :3])[0] for step in (0 * pitch, pitch)
    ]
    assert misses_px(noisy(still, 0)) < 1e-3
    assert misses_px(noisy(shifted(still, *(seen[1] - seen[0])), 1)) < DETECTION_PX


@pytest.mark.parametrize("size", [(160, 120), (163, 125), (90, 70)])
def test_corners_at_the_border_and_outside_do_not_count(size: tuple[int, int]) -> None:
    """Whatever the size: blocks that are not whole are left out, and too few corners never rest."""
    width, height = size
    picture = cv2.resize(np.random.default_rng(1).integers(0, 256, (12, 16), np.uint8), size)
    x, y = np.meshgrid(np.linspace(-20, width + 20, 9), np.linspace(0, height - 1, 7))
    corners = np.column_stack([x.ravel(), y.ravel()])
    assert RestingBoard(picture, corners).rests_in(picture)
    assert not RestingBoard(picture, corners[corners[:, 0] < 0]).rests_in(picture)
    assert not RestingBoard(picture, corners * np.nan).rests_in(picture)


def hands(still: Picture, corners: Float64[np.ndarray, "n 2"]) -> Iterator[Picture]:
    """Yields the picture with a hand's disc over one marker, then without it."""
    x, y = corners[:4].mean(axis=0).round().astype(int).tolist()
    for step in range(8):
        picture = noisy(still, step)
        if 2 <= step < 5:
            cv2.circle(picture, (x, y), 14, (205, 150, 125), -1)
        yield picture


def test_a_hand_on_a_marker_and_its_leaving_are_noticed(
    camera: SyntheticCamera,
    still: Picture,
    detector: Counted,
    misses_px: Callable[[Picture], float],
) -> None:
    corners = detector.corners_at(camera.pose_at(0))
    searches = []
    for picture in hands(still, corners):
        before = detector.whole + detector.parts
        assert misses_px(picture) < REST_PX
        searches.append(detector.whole + detector.parts > before)
    assert searches == [True, False, True, False, False, True, False, False]


def test_a_board_that_goes_is_gone_at_once_and_found_again(still: Picture, tracker: BoardTracker) -> None:
    assert tracker.detect(noisy(still, 0)) is not None
    assert tracker.detect(noisy(still, 1)) is not None
    covered = np.full_like(still, 128)
    assert tracker.detect(noisy(covered, 2)) is None
    assert tracker.detect(noisy(covered, 3)) is None
    assert tracker.detect(noisy(still, 4)) is not None


def test_other_light_moves_nothing(
    still: Picture, detector: Counted, misses_px: Callable[[Picture], float]
) -> None:
    """Flicker and dimming of all light are told from motion; a shadow's edge over the board is searched anew."""
    gains = [1.0, 0.97, 1.0, 0.94, 0.9, 0.6, 0.6]
    assert max(misses_px(noisy((still * gain).astype(np.uint8), i)) for i, gain in enumerate(gains)) < REST_PX
    before = detector.whole + detector.parts
    shadow = still.copy()
    shadow[:, : still.shape[1] // 2] = (shadow[:, : still.shape[1] // 2] * 0.3).astype(np.uint8)
    assert misses_px(noisy(shadow, 9)) < REST_PX
    assert detector.whole + detector.parts > before
