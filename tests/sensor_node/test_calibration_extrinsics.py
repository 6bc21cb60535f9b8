"""Transforms between sensors: known ones come back, what does not determine them is refused."""

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from jaxtyping import Float64

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.fisheye_lens import FisheyeCalibration
from deltalight.protocol.frames import DepthImage, FisheyePictures, SensorFrame
from deltalight.protocol.poses import rigid_matrix
from deltalight.sensor_node.calibration.depth_extrinsics import DepthView, depth_views, place_depth_sensor
from deltalight.sensor_node.calibration.extrinsics import (
    mean_placement,
    rgb_from_fisheye_poses,
    world_from_fisheye_poses,
)
from deltalight.sensor_node.calibration.poses import mean_pose, target_pose
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera, default_camera, srgb_codes
from deltalight.sensor_node.cameras.synthetic_scene import SAMPLES_PER_EDGE
from tests.sensor_node.calibration_samples import BOARD
from tests.sensor_node.conftest import pose_difference

FISHEYE = CameraModel(
    480,
    480,
    np.array([[260.0, 0, 241.0], [0, 261.0, 238.0], [0, 0, 1]]),
    "equidistant",
    np.array([-0.02, 0.003, 0, 0]),
)
RGB_FROM_FISHEYE = rigid_matrix(cv2.Rodrigues(np.array([0.05, -0.1, 0.6]))[0], (0.04, -0.02, 0.01))
DEPTH_CAMERA = default_camera().resized(320, 240)
# Several degrees: the cameras of an RGB-D sensor are better aligned than this.
RGB_FROM_DEPTH = rigid_matrix(cv2.Rodrigues(np.array([0.01, -0.02, 0.015]))[0], (0.03, -0.005, 0.004))


def fisheye_pictures(
    synthetic: SyntheticCamera, world_from_fisheye: Float64[np.ndarray, "4 4"], timestamp_ns: int
) -> FisheyePictures:
    fine = FISHEYE.resized(FISHEYE.width * SAMPLES_PER_EDGE, FISHEYE.height * SAMPLES_PER_EDGE)
    color = srgb_codes(synthetic.scene.picture(fine, world_from_fisheye))
    dark = np.zeros_like(color)
    calibration = FisheyeCalibration(EquidistantLens(FISHEYE))
    return FisheyePictures(timestamp_ns, (dark, color), (0.001, 0.01), calibration)


def rig_frames(synthetic: SyntheticCamera, indices: range) -> Iterator[SensorFrame]:
    """Frames of a moving rig; its fish-eye camera is nearer to the board so that it sees it large enough."""
    for index in indices:
        frame = synthetic.frame_at(index)
        pose = synthetic.pose_at(index) @ RGB_FROM_FISHEYE
        yield replace(frame, depth=None, fisheye=fisheye_pictures(synthetic, pose, frame.timestamp_ns))


@pytest.fixture(scope="module")
def rig(synthetic: SyntheticCamera) -> list[SensorFrame]:
    return list(rig_frames(synthetic, range(0, 90, 15)))


def test_a_fisheye_on_the_rig_is_placed(synthetic: SyntheticCamera, rig: list[SensorFrame]) -> None:
    assert synthetic.board is not None
    poses = list(rgb_from_fisheye_poses(rig, synthetic.board))
    placed = mean_placement(poses, "rgb_from_fisheye")
    metres, degrees = pose_difference(placed.transform, RGB_FROM_FISHEYE)
    assert metres < 0.002
    assert degrees < 0.15
    assert placed.poses + placed.outliers == 6
    assert placed.spread_m < 0.004


def test_pictures_of_other_moments_are_not_paired(synthetic: SyntheticCamera, rig: list[SensorFrame]) -> None:
    assert synthetic.board is not None
    late = [replace(frame, timestamp_ns=frame.timestamp_ns + 50_000_000) for frame in rig]
    assert list(rgb_from_fisheye_poses(late, synthetic.board)) == []


def test_a_fixed_probe_is_placed_by_each_of_its_pictures_once(
    synthetic: SyntheticCamera, rig: list[SensorFrame]
) -> None:
    assert synthetic.board is not None
    poses = list(world_from_fisheye_poses([rig[0], rig[0], rig[1]], synthetic.board))
    assert len(poses) == 2
    metres, degrees = pose_difference(poses[0], synthetic.pose_at(0) @ RGB_FROM_FISHEYE)
    assert metres < 0.004
    assert degrees < 0.3


def test_a_board_beyond_90_degrees_has_a_pose() -> None:
    lens = EquidistantLens(
        CameraModel(800, 800, np.array([[200.0, 0, 400], [0, 200.0, 400], [0, 0, 1]]), "equidistant")
    )
    turn = cv2.Rodrigues(np.array([0.0, np.radians(85), 0.0]))[0]
    pose = rigid_matrix(turn @ cv2.Rodrigues(np.array([np.pi, 0, 0]))[0], turn @ [-0.1, 0.1, 0.4])
    points = BOARD.points @ pose[:3, :3].T + pose[:3, 3]
    assert points[:, 2].min() < 0
    found = target_pose(BOARD.points, lens.directions(lens.project(points)))
    assert found is not None
    np.testing.assert_allclose(found, pose, atol=1e-6)


def test_points_on_a_line_or_seen_from_behind_have_no_pose() -> None:
    line = np.column_stack([np.linspace(0, 1, 8), np.zeros(8), np.zeros(8)])
    # The board's z, out of the paper, points away from the camera.
    for points, shift in ((line, (0.0, 0.0, 2.0)), (BOARD.points, (-0.1, 0.1, 0.5))):
        rays = points + np.array(shift)
        assert target_pose(points, rays / np.linalg.norm(rays, axis=1)[:, None]) is None


def scattered(count: int, metres: float, radians: float, seed: int = 0) -> list[Float64[np.ndarray, "4 4"]]:
    random = np.random.default_rng(seed)
    noise = [
        rigid_matrix(cv2.Rodrigues(random.normal(0, radians, 3))[0], random.normal(0, metres, 3))
        for _ in range(count)
    ]
    return [RGB_FROM_FISHEYE @ each for each in noise]


def test_the_mean_leaves_outliers_out_and_tells_the_spread() -> None:
    poses = scattered(20, 0.001, 0.002)
    poses[3] = RGB_FROM_FISHEYE @ rigid_matrix(cv2.Rodrigues(np.array([0.5, 0, 0]))[0], (0.2, 0, 0))
    placed = mean_placement(poses, "rgb_from_fisheye")
    assert placed.outliers == 1
    assert placed.spread_m == pytest.approx(0.001 * np.sqrt(3), rel=0.4)
    assert placed.spread_deg == pytest.approx(np.degrees(0.002 * np.sqrt(3)), rel=0.4)
    metres, degrees = pose_difference(placed.transform, RGB_FROM_FISHEYE)
    assert metres < 0.001
    assert degrees < 0.1


def test_the_mean_turn_does_not_depend_on_signs_of_quaternions() -> None:
    about = [rigid_matrix(cv2.Rodrigues(np.array([0, 0, np.pi + a]))[0], (0, 0, 0)) for a in (-0.1, 0.1)]
    np.testing.assert_allclose(mean_pose(about)[:3, :3], np.diag([-1.0, -1, 1]), atol=1e-9)


@pytest.mark.parametrize(
    ("poses", "sentence"),
    [
        (scattered(3, 0.001, 0.002), "only 3 moments"),
        (scattered(20, 0.02, 0.002), "spread by"),
        (scattered(20, 0.001, 0.03), "spread by"),
    ],
    ids=["few", "shifted", "turned"],
)
def test_poses_that_say_little_are_refused(poses: list[Float64[np.ndarray, "4 4"]], sentence: str) -> None:
    with pytest.raises(DeltalightError, match=sentence):
        mean_placement(poses, "rgb_from_fisheye")


def over_the_board(
    synthetic: SyntheticCamera, around: float, tilt: float, distance: float, roll: float
) -> Float64[np.ndarray, "4 4"]:
    away = np.array([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), np.cos(tilt)])
    right = np.cross([0, 1, 0], away)
    right /= np.linalg.norm(right)
    turn = np.column_stack([right, np.cross(-away, right), -away])
    turn = turn @ cv2.Rodrigues(np.array([0, 0, roll]))[0]
    return rigid_matrix(turn, synthetic.scene.center + distance * away)


def depth_view(
    synthetic: SyntheticCamera, pose: Float64[np.ndarray, "4 4"], seed: int, stretch: float = 1.0
) -> DepthView:
    """What a depth sensor with 3 mm of noise at 1 m sees from beside the colour camera."""
    depth = synthetic.scene.trace(DEPTH_CAMERA, pose @ RGB_FROM_DEPTH).depth_m
    noise = np.random.default_rng(seed).normal(0, 0.003, depth.shape) * depth**2
    depth = ((depth + noise) * stretch).astype(np.float32)
    return DepthView(pose, DepthImage(depth, depth > 0, DEPTH_CAMERA))


def all_tilts(synthetic: SyntheticCamera, stretch: float = 1.0) -> list[DepthView]:
    places = [(2 * np.pi * k / 10, np.radians(20 + 20 * (k % 2)), 0.45 + 0.05 * (k % 3)) for k in range(10)]
    return [
        depth_view(synthetic, over_the_board(synthetic, *place, 0.3 * k), k, stretch)
        for k, place in enumerate(places)
    ]


def test_a_depth_sensor_is_placed_by_the_planes_it_measures(synthetic: SyntheticCamera) -> None:
    assert synthetic.board is not None
    placed = place_depth_sensor(all_tilts(synthetic), synthetic.board, np.eye(4))
    metres, degrees = pose_difference(placed.transform, np.linalg.inv(RGB_FROM_DEPTH))
    assert placed.views == 10
    assert metres < 0.0004
    assert degrees < 0.04
    assert placed.rms_m < 0.0005


def test_one_tilt_does_not_place_a_depth_sensor(synthetic: SyntheticCamera) -> None:
    assert synthetic.board is not None
    views = [
        depth_view(synthetic, over_the_board(synthetic, 0.3, 0.4, 0.45 + 0.02 * k, 0.0), k) for k in range(8)
    ]
    with pytest.raises(DeltalightError, match="leave depth_from_rgb uncertain"):
        place_depth_sensor(views, synthetic.board, np.eye(4))


def test_depth_of_another_scale_is_refused(synthetic: SyntheticCamera) -> None:
    assert synthetic.board is not None
    with pytest.raises(DeltalightError, match=r"uncertain|disagree"):
        place_depth_sensor(all_tilts(synthetic, stretch=1.06), synthetic.board, np.eye(4))


def test_depth_that_shows_no_board_is_refused(synthetic: SyntheticCamera) -> None:
    assert synthetic.board is not None
    far = rigid_matrix(np.eye(3), (0.0, 0.0, 0.5))
    with pytest.raises(DeltalightError, match="in only 0 views"):
        place_depth_sensor(all_tilts(synthetic), synthetic.board, far)


def test_frames_without_board_or_depth_are_left_out(synthetic: SyntheticCamera) -> None:
    assert synthetic.board is not None
    frame = synthetic.frame_at(0)
    blank = replace(frame, color=np.zeros_like(frame.color))
    assert len(list(depth_views([frame, blank, replace(frame, depth=None)], synthetic.board))) == 1
