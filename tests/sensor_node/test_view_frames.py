"""Building the renderer's input from raw frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.dataset import open_dataset
from deltalight.protocol.dataset_writer import DatasetWriter
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage, SensorFrame
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera, SyntheticNoise
from deltalight.sensor_node.view_frames import ViewFrameBuilder
from tests.sensor_node.conftest import pose_difference


@pytest.fixture(scope="module")
def camera() -> SyntheticCamera:
    return SyntheticCamera(noise=SyntheticNoise())


def write(path: Path, camera: SyntheticCamera, frames: list[SensorFrame]) -> Path:
    with DatasetWriter(path, board=camera.board) as writer:
        for frame in frames:
            writer.add(frame)
    return path


def test_pose_and_depth_are_found_and_the_picture_is_untouched(camera: SyntheticCamera) -> None:
    frame = camera.frame_at(3)
    view = ViewFrameBuilder(camera)(frame)
    assert view.color is frame.color
    assert (view.frame_id, view.timestamp_ns) == (frame.frame_id, frame.timestamp_ns)
    assert view.board is camera.board
    assert view.pose is not None
    metres, degrees = pose_difference(view.pose.world_from_camera, camera.pose_at(3))
    assert metres < 0.001
    assert degrees < 0.1
    assert view.depth is not None
    assert frame.depth is not None
    truth = camera.scene.trace(camera.camera, camera.pose_at(3)).depth_m
    before = np.abs(frame.depth.depth_m - truth)[frame.depth.valid].mean()
    assert np.abs(view.depth.depth_m - truth)[view.depth.valid].mean() < 0.4 * before
    assert view.depth.valid.mean() > 0.99


def test_a_repeated_picture_is_not_examined_again(camera: SyntheticCamera) -> None:
    builder, first, other = ViewFrameBuilder(camera), camera.frame_at(3), camera.frame_at(5)
    view, again = builder(first), builder(replace(first, frame_id=9, timestamp_ns=10**9))
    assert (again.frame_id, again.timestamp_ns) == (9, 10**9)
    assert again.pose is view.pose
    assert again.depth is view.depth
    changed = builder(replace(first, color=other.color))
    assert changed.pose is not None
    assert pose_difference(changed.pose.world_from_camera, camera.pose_at(5))[0] < 0.001
    assert builder(replace(first, color=other.color, depth=other.depth)).depth is not changed.depth


def test_a_given_pose_wins_over_the_board(camera: SyntheticCamera) -> None:
    given = np.eye(4)
    given[:3, 3] = [1, 2, 3]
    view = ViewFrameBuilder(camera)(replace(camera.frame_at(0), world_from_camera=given))
    assert view.pose is not None
    np.testing.assert_array_equal(view.pose.world_from_camera, given)
    with pytest.raises(DeltalightError, match="rigid"):
        ViewFrameBuilder(camera)(replace(camera.frame_at(0), world_from_camera=2 * given))


def test_a_frame_without_the_board_has_no_pose(camera: SyntheticCamera) -> None:
    blank = replace(camera.frame_at(0), color=np.full((480, 640, 3), 90, np.uint8))
    assert ViewFrameBuilder(camera)(blank).pose is None


def test_exposure_is_told_relative_to_the_first_frame(camera: SyntheticCamera) -> None:
    builder = ViewFrameBuilder(camera)
    assert builder(replace(camera.frame_at(0), exposure_s=0.01)).exposure_scale == 1
    assert builder(replace(camera.frame_at(1), exposure_s=0.02)).exposure_scale == pytest.approx(2)
    assert builder(camera.frame_at(2)).exposure_scale == 1


def test_a_source_without_depth_is_an_error_only_where_depth_is_needed(
    camera: SyntheticCamera, tmp_path: Path
) -> None:
    bare = [replace(camera.frame_at(index), depth=None, depth_timestamp_ns=None) for index in range(2)]
    source = open_dataset(write(tmp_path / "bare", camera, bare))
    assert ViewFrameBuilder(source)(source[0]).depth is None
    with pytest.raises(DeltalightError, match="the source has none"):
        ViewFrameBuilder(source, needs_depth=True)
    with pytest.raises(DeltalightError, match="the source has none"):
        ViewFrameBuilder(camera, needs_depth=True)(bare[0])


def test_one_frame_without_depth_is_unknown_everywhere(camera: SyntheticCamera) -> None:
    builder = ViewFrameBuilder(camera, needs_depth=True)
    builder(camera.frame_at(0))
    view = builder(replace(camera.frame_at(1), depth=None, depth_timestamp_ns=None))
    assert view.depth is not None
    assert not view.depth.valid.any()


def test_a_frame_comes_out_the_same_wherever_a_run_begins(camera: SyntheticCamera, tmp_path: Path) -> None:
    source = open_dataset(write(tmp_path / "take", camera, [camera.frame_at(index) for index in range(3)]))
    whole = ViewFrameBuilder(source)
    for index in range(2):
        whole(source[index])
    first, second = whole(source[2]), ViewFrameBuilder(source)(source[2])
    assert first.depth is not None
    assert second.depth is not None
    np.testing.assert_array_equal(first.depth.depth_m, second.depth.depth_m)
    assert first.pose is not None
    assert second.pose is not None
    np.testing.assert_array_equal(first.pose.world_from_camera, second.pose.world_from_camera)


def test_depth_of_another_camera_is_registered(camera: SyntheticCamera) -> None:
    other = CameraModel(320, 240, np.array([[240.0, 0, 160], [0, 240.0, 120], [0, 0, 1]]))
    depth_m = camera.scene.trace(other, camera.pose_at(5)).depth_m
    frame = replace(camera.frame_at(5), depth=DepthImage(depth_m, depth_m > 0, other, 0.001))
    view = ViewFrameBuilder(camera)(frame)
    assert view.depth is not None
    assert view.depth.camera == camera.camera
    truth = camera.scene.trace(camera.camera, camera.pose_at(5)).depth_m
    assert np.median(np.abs(view.depth.depth_m - truth)[view.depth.valid]) < 0.002
    assert view.depth.valid[60:-60, 60:-60].mean() > 0.98


@pytest.mark.data
def test_real_frames_give_pose_and_smooth_depth(shared_data: Path) -> None:
    source = open_dataset(shared_data / "rgbd" / "visp_rbt_apriltag")
    view = ViewFrameBuilder(source, needs_depth=True)(source[10])
    assert view.pose is not None
    assert view.depth is not None
    raw = source[10].depth
    assert raw is not None
    assert view.depth.valid.mean() > raw.valid.mean()
    # Of the markers that nothing hides the depth agrees with the pose found in the picture.
    camera_from_world = np.linalg.inv(view.pose.world_from_camera)
    assert view.board is not None
    for name in (1, 2, 5, 6, 9, 10):
        centre = camera_from_world @ [*view.board.corner_points()[name].mean(axis=0), 1]
        column, row = np.rint(source.camera.project(centre[None, :3])[0]).astype(int)
        assert view.depth.depth_m[row, column] == pytest.approx(centre[2], abs=0.03)
