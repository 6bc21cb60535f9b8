"""What is kept of one camera's frames."""

import numpy as np
import pytest

from deltalight.protocol.frames import DepthImage
from deltalight.render_server.camera_history import SAMPLE_STEP, CameraHistory
from deltalight.render_server.scene.motion_detection import FrameSamples, MotionDetector
from deltalight.render_server.view import CameraView, PosedFrame
from tests.render_server.scenes import checkered, depth_image, floor_depth, frame, look_at, plain


def typical_depth(depth: DepthImage) -> float:
    pose = look_at((0.25, -0.9, 0.65))
    seen = frame(checkered(), pose=pose, depth=depth)
    history = CameraHistory(keeps_world=False, has_depth=True)
    view = CameraView(seen.camera, pose.world_from_camera)
    history.update(PosedFrame(seen, view), is_unknown=True)
    return history.scan(view.size).typical_depth


def floor() -> DepthImage:
    return depth_image(floor_depth(look_at((0.25, -0.9, 0.65))))


@pytest.mark.parametrize("share", [1.0, 0.9, 0.3, 0.001])
def test_the_typical_depth_is_the_median(share: float) -> None:
    depth = floor()
    random = np.random.default_rng(7)
    for _ in range(5):  # even and odd numbers of pixels
        depth.valid[:] = random.random(depth.valid.shape) < share
        assert depth.valid.any()
        assert typical_depth(depth) == np.median(depth.depth_m[depth.valid])


def test_the_typical_depth_is_the_median_where_a_sample_tells_another() -> None:
    depth = floor()
    depth.depth_m.ravel()[::SAMPLE_STEP] = 9.0
    depth.valid[:] = True
    assert typical_depth(depth) == np.median(depth.depth_m)


def test_without_depth_it_is_a_metre() -> None:
    depth = floor()
    depth.valid[:] = False
    assert typical_depth(depth) == 1.0


@pytest.mark.parametrize("expected", ["the frame", "another"])
def test_a_still_camera_s_change_of_light_is_found_whatever_was_expected(expected: str) -> None:
    camera = CameraHistory(keeps_world=False, has_depth=True)
    dim, bright = (frame(plain(code)) for code in (100, 140))
    view = CameraView(dim.camera, look_at().world_from_camera)
    same, brighter = PosedFrame(dim, view), PosedFrame(bright, view)
    assert camera.update(same, is_unknown=False)
    assert not camera.update(same, is_unknown=False)
    camera.expect(brighter if expected == "the frame" else same)
    assert camera.update(brighter, is_unknown=False)


def test_a_frame_that_was_expected_moves_as_much_as_one_that_was_not() -> None:
    """Also one that looks like the reference, but for a tenth of its pixels."""
    board = checkered()
    changed = board.copy()
    changed[: len(board) // 10] //= 2
    for picture, moves in ((board, False), (changed, True)):
        found = []
        for expected in (True, False):
            detector, coming = MotionDetector(), FrameSamples(frame(picture))
            assert detector.update(FrameSamples(frame(board)))
            if expected:
                detector.expect(coming)
            found.append(detector.update(coming))
        assert found == [moves, moves]
