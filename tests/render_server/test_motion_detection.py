import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import BoardPose, DepthImage, ViewFrame
from deltalight.render_server.scene.motion_detection import FrameSamples, KeptWorld, MotionDetector

CAMERA = CameraModel(160, 120, np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]]))
SIGMA = 0.002


def frame(seed: int = 0, shift_m: float = 0.0, turn_rad: float = 0.0) -> ViewFrame:
    """A wall at 1 m with a picture of it, both noisy."""
    rng = np.random.default_rng(seed)
    columns = np.arange(160)
    picture = np.broadcast_to(60 + columns[None, :, None], (120, 160, 3))
    color = np.clip(picture + rng.normal(0, 1.5, (120, 160, 3)), 0, 255).astype(np.uint8)
    depth_m = (1 + SIGMA * rng.normal(size=(120, 160))).astype(np.float32)
    pose = np.eye(4)
    pose[0, 3] = shift_m
    pose[:2, :2] = [[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]]
    depth = DepthImage(depth_m, np.ones((120, 160), bool), CAMERA, SIGMA)
    return ViewFrame(0, 0, color, CAMERA, pose=BoardPose(pose), depth=depth)


def changed(**changes: object) -> ViewFrame:
    return ViewFrame(**{**vars(frame(1)), **changes})


def test_noise_alone_is_no_change() -> None:
    tracker = MotionDetector()
    assert tracker.update(FrameSamples(frame(0)))
    assert not any(tracker.update(FrameSamples(frame(seed))) for seed in range(1, 20))


@pytest.mark.parametrize(
    ("shift_m", "turn_rad", "expected"), [(0.002, 0, False), (0.006, 0, True), (0, 0.01, True)]
)
def test_motion_of_the_camera_counts_from_half_a_pixel_on(
    shift_m: float, turn_rad: float, expected: bool
) -> None:
    tracker = MotionDetector()
    tracker.update(FrameSamples(frame(0)))
    assert tracker.update(FrameSamples(frame(1, shift_m, turn_rad))) is expected


def test_a_turned_camera_asks_for_no_colour() -> None:
    tracker, samples = MotionDetector(), [FrameSamples(frame(0)), FrameSamples(frame(1, turn_rad=0.01))]
    assert all(tracker.update(each) for each in samples)
    assert not any("color" in vars(each) for each in samples)


def test_the_nearest_things_move_the_picture_most() -> None:
    """The wall moves by 0.3 pixels, the tenth of it that is five times nearer by 1.5."""
    still, moved = frame(0), frame(1, shift_m=0.002)
    for each in (still, moved):
        assert each.depth is not None
        each.depth.depth_m[:12] = 0.2
    tracker = MotionDetector()
    tracker.update(FrameSamples(still))
    assert tracker.update(FrameSamples(moved))


def test_slow_drift_adds_up() -> None:
    tracker = MotionDetector()
    answers = [tracker.update(FrameSamples(frame(step, shift_m=0.001 * step))) for step in range(9)]
    assert answers[0]
    assert not answers[1]
    assert any(answers[2:])


def test_depth_that_moves_counts() -> None:
    tracker = MotionDetector()
    tracker.update(FrameSamples(frame(0)))
    moved = frame(1).depth
    assert moved is not None
    moved.depth_m[20:60, 20:60] -= 0.03
    assert tracker.update(FrameSamples(changed(depth=moved)))
    assert not tracker.update(FrameSamples(changed(depth=moved)))


def test_light_that_changes_counts_and_exposure_that_is_known_does_not() -> None:
    tracker = MotionDetector()
    tracker.update(FrameSamples(frame(0)))
    lit = frame(1).color.copy()
    lit[40:70, 40:70] = np.minimum(lit[40:70, 40:70].astype(int) + 25, 255)
    assert tracker.update(FrameSamples(changed(color=lit)))
    tracker = MotionDetector()
    bright = changed(color=np.full((120, 160, 3), 188, np.uint8))
    dark = changed(color=np.full((120, 160, 3), 137, np.uint8), exposure_scale=0.5)
    tracker.update(FrameSamples(bright))
    assert not tracker.update(FrameSamples(dark))
    assert tracker.update(FrameSamples(changed(color=dark.color)))


def test_losing_pose_or_depth_or_changing_the_camera_counts() -> None:
    other = CameraModel(160, 120, np.array([[151.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]]))
    for changes in ({"pose": None}, {"depth": None}, {"camera": other}):
        tracker = MotionDetector()
        tracker.update(FrameSamples(frame(0)))
        assert tracker.update(FrameSamples(changed(**changes)))
        assert not tracker.update(FrameSamples(changed(**changes)))


def test_without_depth_the_distance_to_the_board_serves() -> None:
    tracker = MotionDetector()
    near, far = np.eye(4), np.eye(4)
    near[2, 3], far[2, 3] = -1.0, -1.0
    far[0, 3] = 0.006
    tracker.update(FrameSamples(changed(depth=None, pose=BoardPose(near))))
    assert not tracker.update(FrameSamples(changed(depth=None, pose=BoardPose(near.copy()))))
    assert tracker.update(FrameSamples(changed(depth=None, pose=BoardPose(far))))


def test_a_kept_world_tells_at_once_or_a_frame_late_what_it_explains() -> None:
    kept, built, turned = KeptWorld(), FrameSamples(frame()), FrameSamples(frame(seed=1, turn_rad=0.01))
    away = [FrameSamples(frame(seed=seed, turn_rad=0.5)) for seed in (2, 3)]
    kept.built_from = built
    assert kept.explains(turned)
    assert not kept.explains(away[0])
    late = KeptWorld()
    late.built_from = built
    assert [late.explained_before(each) for each in (turned, away[0], away[1])] == [True, True, False]
    late.built_from = away[1]
    assert late.explained_before(away[0]), "what an earlier world did not explain says nothing of this one"


def striped(size: tuple[int, int] = (160, 120), shift_px: int = 0) -> ViewFrame:
    """A wall at 1 m with upright stripes narrower than two blocks of the samples' grid; the camera shifts aside."""
    width, height = size
    camera = CameraModel(width, height, np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]]))
    bright = (np.arange(width) + shift_px) % 17 < 5
    color = np.where(bright[None, :, None], np.uint8(230), np.uint8(60)) * np.ones((height, 1, 3), np.uint8)
    pose = np.eye(4)
    pose[0, 3] = shift_px / 150
    depth = DepthImage(np.ones((height, width), np.float32), np.ones((height, width), bool), camera, SIGMA)
    return ViewFrame(0, 0, color, camera, pose=BoardPose(pose), depth=depth)


def explained(old: ViewFrame, new: ViewFrame) -> bool:
    kept = KeptWorld()
    kept.built_from = FrameSamples(old)
    return kept.explains(FrameSamples(new))


@pytest.mark.parametrize("size", [(160, 120), (163, 120), (160, 123), (163, 123), (161, 122)])
@pytest.mark.parametrize("shift_px", range(1, 8))
def test_narrow_stripes_are_known_from_elsewhere_in_a_picture_of_any_size(
    size: tuple[int, int], shift_px: int
) -> None:
    assert explained(striped(size), striped(size, shift_px))


def test_what_is_laid_on_stripes_is_new() -> None:
    seen = striped(shift_px=3)
    seen.color[40:64, 60:84] = (250, 30, 30)
    assert not explained(striped(), seen)
