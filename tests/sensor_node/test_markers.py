"""Board pose: against the synthetic truth, and on real captures."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.benchmarks.soak.station import resized
from deltalight.benchmarks.speed.motions import STANDING
from deltalight.protocol.board import BoardSpec, load_board_yaml
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.dataset import open_dataset
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.source import open_source
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera, default_camera, srgb_codes
from deltalight.sensor_node.markers import BoardDetector
from deltalight.services.demo import RECORDING
from tests.sensor_node.conftest import pose_difference

MATRIX = np.array([[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]])
CAMERAS = {
    "pinhole": default_camera(),
    "plumb_bob": CameraModel(640, 480, MATRIX, "plumb_bob", np.array([-0.2, 0.05, 0.001, -0.001, 0])),
    "equidistant": CameraModel(
        640,
        480,
        MATRIX * [[0.7], [0.7], [1]] + [[0, 0, 96], [0, 0, 72], [0, 0, 0]],
        "equidistant",
        np.array([0.02, -0.01, 0, 0]),
    ),
}
APRIL = {
    "type": "apriltag_grid",
    "dictionary": "DICT_APRILTAG_36h11",
    "marker_length_m": 0.05,
    "separation_m": 0.015,
    "rows": 3,
    "columns": 4,
}
CHARUCO = {
    "type": "charuco",
    "dictionary": "DICT_5X5_50",
    "marker_length_m": 0.03,
    "separation_m": 0.01,
    "rows": 5,
    "columns": 7,
}
SINGLE = {
    "type": "single",
    "dictionary": "DICT_6X6_50",
    "marker_length_m": 0.15,
    "separation_m": 0.05,
    "first_id": 7,
}
CUSTOM = {
    **SINGLE,
    "first_id": None,
    "dictionary": {"marker_size": 4, "border_bits": 2, "bits": "1101001110000111"},
}


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_pose_of_the_synthetic_board_is_true_within_1_mm_and_a_tenth_degree(camera: CameraModel) -> None:
    synthetic = SyntheticCamera(camera=camera)
    assert synthetic.board is not None
    detector = BoardDetector(synthetic.board, camera)
    for index in range(0, 90, 18):
        pose = detector.detect(synthetic.frame_at(index).color)
        assert pose is not None
        metres, degrees = pose_difference(pose.world_from_camera, synthetic.pose_at(index))
        assert metres < 0.001
        assert degrees < 0.1
        assert pose.reprojection_error_px is not None
        assert pose.reprojection_error_px < 0.3


@pytest.mark.parametrize(
    "board", [APRIL, CHARUCO, SINGLE, CUSTOM], ids=["april", "charuco", "single", "custom"]
)
def test_every_type_of_board_is_found(board: dict[str, object]) -> None:
    synthetic = SyntheticCamera(BoardSpec.model_validate(board))
    assert synthetic.board is not None
    detector = BoardDetector(synthetic.board, synthetic.camera)
    for index in (5, 35, 65):
        pose = detector.detect(synthetic.frame_at(index).color)
        assert pose is not None
        metres, degrees = pose_difference(pose.world_from_camera, synthetic.pose_at(index))
        assert metres < 0.0025
        assert degrees < 0.3


def test_a_few_visible_markers_are_enough(synthetic: SyntheticCamera) -> None:
    assert synthetic.board is not None
    frame = synthetic.frame_at(0)
    pose = synthetic.pose_at(0)
    color = frame.color.copy()
    keep = [0, 6]
    for name, corners in synthetic.board.corner_points().items():
        if name not in keep:
            camera_points = (corners - pose[:3, 3]) @ pose[:3, :3]
            polygon = np.rint(synthetic.camera.project(camera_points)).astype(np.int32)
            cv2.fillConvexPoly(color, polygon, (200, 200, 200))
    found = BoardDetector(synthetic.board, synthetic.camera).detect(color)
    assert found is not None
    metres, degrees = pose_difference(found.world_from_camera, pose)
    assert metres < 0.004
    assert degrees < 0.7


def whitened(color: np.ndarray, quad: np.ndarray, share: float) -> np.ndarray:
    """The picture with the middle of a marker's place painted white, `share` of its edge wide."""
    middle = quad.mean(axis=0)
    inner = np.rint(middle + share * (quad - middle)).astype(np.int32)
    return cv2.fillConvexPoly(color.copy(), inner, (235, 235, 235))


def test_a_marker_that_cannot_be_read_is_recognized_by_its_place(synthetic: SyntheticCamera) -> None:
    """With its bits gone its black frame still says where it is: as good a pose as with all of them."""
    assert synthetic.board is not None
    frame, pose = synthetic.frame_at(0), synthetic.pose_at(0)
    camera = (synthetic.board.corner_points()[0] - pose[:3, 3]) @ pose[:3, :3]
    color = whitened(frame.color, synthetic.camera.project(camera), 0.66)
    detector = BoardDetector(synthetic.board, synthetic.camera)
    whole, without_bits = detector.detect(frame.color), detector.detect(color)
    assert whole is not None
    assert without_bits is not None
    np.testing.assert_allclose(without_bits.world_from_camera, whole.world_from_camera, atol=2e-5)
    matches = detector._find(color)
    assert matches is not None
    assert len(matches.world) == 4 * len(synthetic.board.corner_points())


def test_another_quad_at_the_place_of_a_marker_is_not_taken_for_it(synthetic: SyntheticCamera) -> None:
    assert synthetic.board is not None
    frame, pose = synthetic.frame_at(0), synthetic.pose_at(0)
    camera = (synthetic.board.corner_points()[0] - pose[:3, 3]) @ pose[:3, :3]
    quad = synthetic.camera.project(camera)
    middle = quad.mean(axis=0)
    color = whitened(frame.color, quad, 1.15)
    smaller = np.rint(middle + 0.6 * (quad - middle)).astype(np.int32)
    color = cv2.fillConvexPoly(color, smaller, (10, 10, 10))
    matches = BoardDetector(synthetic.board, synthetic.camera)._find(color)
    assert matches is not None
    assert len(matches.world) == 4 * (len(synthetic.board.corner_points()) - 1)


def test_the_pose_of_a_resting_camera_does_not_jump_with_markers_that_are_read_now_and_then() -> None:
    """Of the demo at 320x240, where two markers are barely large enough: they moved the board by a pixel."""
    source = open_source(RECORDING)
    assert source.board is not None
    frames = [resized(source[number], (320, 240)) for number in STANDING]
    detector = BoardDetector(source.board, frames[0].camera, frames[0].response)
    poses = [detector.detect(frame.color) for frame in frames]
    turns = [
        pose_difference(pose.world_from_camera, poses[0].world_from_camera)[1]
        for pose in poses
        if pose is not None and poses[0] is not None
    ]
    assert len(turns) == len(frames)
    assert max(turns) < 0.05


def test_corners_are_refined_on_linear_light_of_the_cameras_response(synthetic: SyntheticCamera) -> None:
    """Black edges must not move inward when the camera's coding is not sRGB."""
    assert synthetic.board is not None
    pose = synthetic.pose_at(10)
    linear = synthetic.scene.picture(synthetic.camera.resized(1280, 960), pose)
    linear = cv2.GaussianBlur(linear, (0, 0), 0.7)
    response = np.repeat(((np.arange(256) / 255.0) ** 3.2)[:, None], 3, axis=1).astype(np.float32)
    color = np.rint(255 * np.clip(linear, 0, 1) ** (1 / 3.2)).astype(np.uint8)
    wrong = BoardDetector(synthetic.board, synthetic.camera).detect(color)
    right = BoardDetector(synthetic.board, synthetic.camera, response).detect(color)
    assert wrong is not None
    assert right is not None
    off_right, _ = pose_difference(right.world_from_camera, pose)
    off_wrong, _ = pose_difference(wrong.world_from_camera, pose)
    assert off_right < 0.0012
    assert off_right < off_wrong


def test_no_board_is_no_pose_and_no_error(synthetic: SyntheticCamera) -> None:
    assert synthetic.board is not None
    detector = BoardDetector(synthetic.board, synthetic.camera)
    assert detector.detect(np.full((480, 640, 3), 128, np.uint8)) is None
    assert detector.detect(np.random.default_rng(0).integers(0, 256, (480, 640, 3)).astype(np.uint8)) is None


def test_another_board_of_the_same_dictionary_is_not_taken_for_it(synthetic: SyntheticCamera) -> None:
    """The same ids in another layout fit nowhere."""
    assert synthetic.board is not None
    other = synthetic.board.replaced(rows=4, columns=3)
    assert BoardDetector(other, synthetic.camera).detect(synthetic.frame_at(0).color) is None


def test_both_planar_solutions_are_kept_and_history_decides_an_ambiguous_one() -> None:
    """A small single marker seen almost from the front, far away: both solutions fit nearly as well."""
    board = BoardSpec.model_validate({**SINGLE, "marker_length_m": 0.03})
    synthetic = SyntheticCamera(board)
    pose = np.eye(4)
    tilt = np.radians(12)
    pose[:3, :3] = np.array([[1, 0, 0], [0, -np.cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), -np.cos(tilt)]])
    pose[:3, 3] = synthetic.scene.center - 0.75 * pose[:3, 2]
    color = srgb_codes(synthetic.scene.picture(synthetic.camera.resized(1280, 960), pose))
    alone = BoardDetector(board, synthetic.camera).detect(color)
    assert alone is not None
    assert alone.alternative is not None
    _, apart = pose_difference(alone.world_from_camera, alone.alternative)
    assert apart > 5
    candidates = [alone.world_from_camera, alone.alternative]
    best = min(pose_difference(candidate, pose)[1] for candidate in candidates)
    assert best < 5
    for candidate in candidates:
        detector = BoardDetector(board, synthetic.camera)
        detector._previous = candidate
        again = detector.detect(color)
        assert again is not None
        assert pose_difference(again.world_from_camera, candidate)[1] < 1e-3


def test_a_picture_of_another_size_is_refused(synthetic: SyntheticCamera) -> None:
    assert synthetic.board is not None
    with pytest.raises(DeltalightError, match="64x48 pixels but its camera 640x480"):
        BoardDetector(synthetic.board, synthetic.camera).detect(np.zeros((48, 64, 3), np.uint8))


def test_an_unknown_dictionary_is_refused_with_the_nearest_name(tmp_path: Path) -> None:
    path = tmp_path / "board.yaml"
    path.write_text("type: aruco_grid\ndictionary: DICT_4X4_5O\nmarker_length_m: 0.05\n")
    with pytest.raises(DeltalightError, match="DICT_4X4_50"):
        load_board_yaml(path)


@pytest.mark.data
def test_real_apriltag_grid_agrees_with_the_published_poses(shared_data: Path) -> None:
    folder = shared_data / "rgbd" / "visp_rbt_apriltag"
    reader = open_dataset(folder)
    assert reader.board is not None
    published = json.loads((folder / "apriltag_data.json").read_text())["grid"]
    detector = BoardDetector(reader.board, reader.camera)
    ours, theirs, errors = [], [], []
    for frame in reader:
        pose = detector.detect(frame.color)
        assert pose is not None, f"no board in frame {frame.frame_id}"
        assert pose.reprojection_error_px is not None
        ours.append(np.linalg.inv(pose.world_from_camera))
        theirs.append(np.array(published[2 * frame.frame_id]).reshape(4, 4))
        errors.append(pose.reprojection_error_px)
    assert np.mean(errors) < 1
    # camera_from_grid (theirs) = camera_from_world (ours) @ one constant world_from_grid.
    constants = np.array([np.linalg.inv(our) @ their for our, their in zip(ours, theirs, strict=True)])
    left, _, right = np.linalg.svd(constants[:, :3, :3].sum(axis=0))
    world_from_grid = np.eye(4)
    world_from_grid[:3, :3] = left @ right
    world_from_grid[:3, 3] = np.median(constants[:, :3, 3], axis=0)
    for our, their in zip(ours, theirs, strict=True):
        metres, degrees = pose_difference(our @ world_from_grid, their)
        assert metres < 0.01
        assert degrees < 1


@pytest.mark.data
def test_marker_of_the_papers_photograph_is_found(shared_data: Path, tmp_path: Path) -> None:
    data = shared_data / "paper_scene_dirtchamber" / "data"
    matrix = np.array([[657.467, 0, 319.5], [0, 657.467, 239.5], [0, 0, 1]])
    camera = CameraModel(640, 480, matrix, "plumb_bob", np.array([-0.418023, 0.507152, 0, 0, -0.578436]))
    path = tmp_path / "board.yaml"
    (tmp_path / "marker.png").write_bytes((data / "marker.png").read_bytes())
    path.write_text(
        "type: single\nmarker_length_m: 0.1\nseparation_m: 0.02\n"
        "dictionary: {marker_size: 6, border_bits: 3, image: marker.png}\n"
    )
    color = cv2.cvtColor(cv2.imread(str(data / "real_static_scene.png")), cv2.COLOR_BGR2RGB)
    board = load_board_yaml(path)
    pose = BoardDetector(board, camera).detect(color)
    assert pose is not None
    assert pose.reprojection_error_px is not None
    assert pose.reprojection_error_px < 1
    corners = board.corner_points()[0]
    world_from_camera = pose.world_from_camera
    pixels = camera.project((corners - world_from_camera[:3, 3]) @ world_from_camera[:3, :3])
    np.testing.assert_allclose(pixels.min(axis=0), [220, 311], atol=3)
    np.testing.assert_allclose(pixels.max(axis=0), [317, 373], atol=3)
    assert world_from_camera[2, 3] > 0


@pytest.mark.data
@pytest.mark.parametrize("name", ["DICT_6X6_250", "DICT_ARUCO_ORIGINAL"])
def test_a_board_that_opencv_does_not_know_is_not_found(shared_data: Path, name: str) -> None:
    path = shared_data / "rgbd" / "linemod_markerboard" / "0000_rgb.png"
    color = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    camera = CameraModel(640, 480, np.array([[572.4, 0, 325.3], [0, 573.6, 242.0], [0, 0, 1]]))
    board = BoardSpec.model_validate(
        {
            "type": "aruco_grid",
            "dictionary": name,
            "marker_length_m": 0.05,
            "separation_m": 0.01,
            "rows": 4,
            "columns": 4,
        }
    )
    assert BoardDetector(board, camera).detect(color) is None


@pytest.mark.data
def test_real_charuco_board_is_found(shared_data: Path) -> None:
    folder = shared_data / "aruco_photos" / "opencv"
    camera_file = cv2.FileStorage(str(folder / "tutorial_camera_charuco.yml"), cv2.FILE_STORAGE_READ)
    color = cv2.cvtColor(cv2.imread(str(folder / "choriginal.jpg")), cv2.COLOR_BGR2RGB)
    camera = CameraModel(
        color.shape[1],
        color.shape[0],
        camera_file.getNode("camera_matrix").mat(),
        "plumb_bob",
        camera_file.getNode("distortion_coefficients").mat().ravel(),
    )
    board = BoardSpec.model_validate(
        {**CHARUCO, "dictionary": "DICT_6X6_250", "rows": 7, "columns": 5, "marker_length_m": 0.02}
    )
    pose = BoardDetector(board, camera).detect(color)
    assert pose is not None
    assert pose.reprojection_error_px is not None
    assert pose.reprojection_error_px < 1
