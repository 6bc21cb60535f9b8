"""Markers on lamps: where they are, which of two poses it is, which ids they may have."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from deltalight.protocol.board import BoardSpec, LampMarker, load_board_yaml, save_board_yaml
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import LampPose
from deltalight.protocol.poses import rigid_matrix
from deltalight.sensor_node import lamp_markers
from deltalight.sensor_node.cameras.synthetic import default_camera, srgb_codes
from deltalight.sensor_node.lamp_markers import detect_lamps
from tests.sensor_node.conftest import pose_difference

LENGTH_M = 0.06
WORLD_FROM_CAMERA = rigid_matrix(cv2.Rodrigues(np.array([2.4, 0.3, -0.2]))[0], (0.2, -0.4, 0.9))
DISTORTED = CameraModel(
    640, 480, default_camera().matrix, "plumb_bob", np.array([-0.25, 0.08, 0.001, -0.001, 0.0])
)


def board(**changes: object) -> BoardSpec:
    values = {
        "type": "aruco_grid",
        "dictionary": "DICT_4X4_50",
        "marker_length_m": 0.05,
        "separation_m": 0.01,
        "rows": 3,
        "columns": 4,
        "lamp_markers": [{"id": 30, "marker_length_m": LENGTH_M}, {"id": 20, "marker_length_m": LENGTH_M}],
    }
    return BoardSpec.model_validate({**values, **changes})


def facing(place: tuple[float, float, float], tilt_x: float, tilt_y: float = 0.0) -> np.ndarray:
    """camera_from_marker of a marker that looks at the camera, upright, tilted by two angles."""
    upright = np.diag([1.0, -1, -1])
    turn = cv2.Rodrigues(np.array([tilt_x, 0, 0]))[0] @ cv2.Rodrigues(np.array([0, tilt_y, 0]))[0]
    return rigid_matrix(upright @ turn, place)


@cache
def finer(camera: CameraModel) -> CameraModel:
    return camera.resized(2 * camera.width, 2 * camera.height)


def picture(camera: CameraModel, markers: dict[int, np.ndarray]) -> np.ndarray:
    """Linear picture of markers (camera_from_marker) with a white margin of a cell, on grey."""
    fine = finer(camera)
    rays = np.concatenate([fine.rays().astype(np.float64), np.ones((fine.height, fine.width, 1))], axis=-1)
    light = np.full((fine.height, fine.width), 0.3)
    for name, pose in markers.items():
        cells = np.pad(
            board().opencv_dictionary().generateImageMarker(name, 6) > 127, 1, constant_values=True
        )
        normal = pose[:3, 2]
        scale = (normal @ pose[:3, 3]) / (rays @ normal)
        local = (rays * scale[..., None] - pose[:3, 3]) @ pose[:3, :3]
        column, row = (np.floor(value / LENGTH_M * 6 + 4) for value in (local[..., 0], -local[..., 1]))
        inside = (column >= 0) & (column < 8) & (row >= 0) & (row < 8) & (scale > 0)
        light[inside] = np.where(cells[row[inside].astype(int), column[inside].astype(int)], 0.7, 0.03)
    small = cv2.resize(light, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.repeat(small[..., None], 3, axis=-1).astype(np.float32)


@pytest.mark.parametrize("camera", [default_camera(), DISTORTED], ids=["pinhole", "distorted"])
def test_the_pose_is_true_within_2_mm_and_a_degree(camera: CameraModel) -> None:
    for place, tilt_x, tilt_y in (((0.05, 0.02, 0.5), 0.6, 0.3), ((-0.15, 0.1, 0.6), -0.5, 0.5)):
        truth = facing(place, tilt_x, tilt_y)
        color = srgb_codes(picture(camera, {20: truth}))
        (lamp,) = detect_lamps(color, board(), camera, None, WORLD_FROM_CAMERA)
        assert lamp.marker == 20
        metres, degrees = pose_difference(lamp.world_from_marker, WORLD_FROM_CAMERA @ truth)
        assert metres < 0.002
        assert degrees < 1


def test_lamps_come_in_the_boards_order_without_the_boards_own_markers() -> None:
    camera = default_camera()
    seen = {20: facing((0.1, 0, 0.5), 0.5), 30: facing((-0.1, 0, 0.5), 0.5), 3: facing((0, 0.12, 0.5), 0.5)}
    color = srgb_codes(picture(camera, seen))
    found = detect_lamps(color, board(), camera, None, WORLD_FROM_CAMERA)
    assert [lamp.marker for lamp in found] == [30, 20]
    assert detect_lamps(color, board(lamp_markers=[]), camera, None, WORLD_FROM_CAMERA) == ()
    only = board(lamp_markers=[{"id": 40, "marker_length_m": LENGTH_M}])
    assert detect_lamps(color, only, camera, None, WORLD_FROM_CAMERA) == ()


def test_edges_are_found_on_linear_light_of_the_cameras_response() -> None:
    camera, truth = default_camera(), facing((0.05, 0.02, 0.5), 0.6, 0.3)
    linear = cv2.GaussianBlur(picture(camera, {20: truth}), (0, 0), 0.9)
    response = np.repeat(((np.arange(256) / 255.0) ** 3.2)[:, None], 3, axis=1).astype(np.float32)
    color = np.rint(255 * np.clip(linear, 0, 1) ** (1 / 3.2)).astype(np.uint8)
    misses = []
    for table in (response, None):
        (lamp,) = detect_lamps(color, board(), camera, table, WORLD_FROM_CAMERA)
        misses.append(pose_difference(lamp.world_from_marker, WORLD_FROM_CAMERA @ truth)[0])
    assert misses[0] < 0.003
    assert misses[0] < misses[1]


def test_the_previous_pose_decides_where_both_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A small marker seen nearly from the front: the two poses differ in tilt and fit alike."""
    monkeypatch.setattr(lamp_markers, "AMBIGUOUS_RATIO", 3.0)  # the errors here are 0.18 and 0.28 px
    camera, truth = default_camera(), facing((0.02, 0.01, 1.6), np.radians(15))
    color = srgb_codes(picture(camera, {20: truth}))
    mirrored = facing((0.02, 0.01, 1.6), np.radians(-15))
    for expected in (truth, mirrored):
        previous = (LampPose(20, WORLD_FROM_CAMERA @ expected), LampPose(30, np.eye(4)))
        (lamp,) = detect_lamps(color, board(), camera, None, WORLD_FROM_CAMERA, previous=previous)
        assert pose_difference(lamp.world_from_marker, WORLD_FROM_CAMERA @ expected)[1] < 5
    (lamp,) = detect_lamps(color, board(), camera, None, WORLD_FROM_CAMERA)
    assert pose_difference(lamp.world_from_marker, WORLD_FROM_CAMERA @ truth)[1] < 5


def test_the_reprojection_error_decides_where_it_can() -> None:
    """A wrong previous pose does not win against a clear picture."""
    camera, truth = default_camera(), facing((0.02, 0.01, 0.35), np.radians(35))
    color = srgb_codes(picture(camera, {20: truth}))
    wrong = (LampPose(20, WORLD_FROM_CAMERA @ facing((0.02, 0.01, 0.35), np.radians(-35))),)
    (lamp,) = detect_lamps(color, board(), camera, None, WORLD_FROM_CAMERA, previous=wrong)
    assert pose_difference(lamp.world_from_marker, WORLD_FROM_CAMERA @ truth)[1] < 1


def test_the_markers_frame_is_its_middle_with_y_up_and_z_out_of_the_paper() -> None:
    corners = LampMarker(id=20, marker_length_m=0.1).corner_points()
    np.testing.assert_allclose(corners[0], [-0.05, 0.05, 0])
    np.testing.assert_allclose(corners[2], [0.05, -0.05, 0])


@pytest.mark.parametrize(
    ("ids", "sentence"),
    [
        ([20, 11], "marker 11 of lamp_markers is also on the board"),
        ([20, 20], "name a marker twice"),
        ([50], "0 to 49"),
    ],
)
def test_ids_that_cannot_be_are_refused(ids: list[int], sentence: str) -> None:
    with pytest.raises(ValidationError, match=sentence):
        board(lamp_markers=[{"id": name, "marker_length_m": 0.05} for name in ids])


def test_lamp_markers_are_kept_in_board_yaml(tmp_path: Path) -> None:
    save_board_yaml(tmp_path / "board.yaml", board())
    assert load_board_yaml(tmp_path / "board.yaml") == board()
