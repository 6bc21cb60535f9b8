"""Board poses on the real capture of a desk: one half of its frames judged by the other, and by the conventions."""

import json
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float64

from deltalight.protocol.dataset import open_dataset
from deltalight.sensor_node.markers import BoardDetector
from tests.sensor_node.conftest import pose_difference

Poses = Float64[np.ndarray, "n 4 4"]


@pytest.fixture(scope="module")
def poses(shared_data: Path) -> tuple[Poses, Poses]:
    """camera_from_board of every frame: ours, and as published for a board frame of its own."""
    folder = shared_data / "rgbd" / "visp_rbt_apriltag"
    reader = open_dataset(folder)
    assert reader.board is not None
    grid = json.loads((folder / "apriltag_data.json").read_text())["grid"]
    numbers = [
        int(Path(line.split()[1]).stem)
        for line in (folder / "rgb.txt").read_text().splitlines()
        if line and not line.startswith("#")
    ]
    detector = BoardDetector(reader.board, reader.camera)
    found = [detector.detect(frame.color) for frame in reader]
    ours = np.array([np.linalg.inv(pose.world_from_camera) for pose in found if pose is not None])
    assert len(ours) == len(numbers) == 30
    return ours, np.array([np.array(grid[number]).reshape(4, 4) for number in numbers])


def constant_between(ours: Poses, theirs: Poses) -> Float64[np.ndarray, "4 4"]:
    """The one rigid transform from their board frame to ours that fits best."""
    each = np.linalg.inv(ours) @ theirs
    left, _, right = np.linalg.svd(each[:, :3, :3].sum(axis=0))
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = left @ right, np.median(each[:, :3, 3], axis=0)
    return result


@pytest.mark.data
@pytest.mark.parametrize("half", [0, 1])
def test_a_constant_found_on_half_of_the_frames_holds_on_the_others(
    poses: tuple[Poses, Poses], half: int
) -> None:
    """Half of them within 3 mm and a quarter degree; every frame's limit is tested in test_markers.py."""
    ours, theirs = poses
    constant = constant_between(ours[half::2], theirs[half::2])
    pairs = zip(ours[1 - half :: 2], theirs[1 - half :: 2], strict=True)
    errors = np.array([pose_difference(our @ constant, their) for our, their in pairs])
    assert np.median(errors[:, 0]) < 0.003
    assert np.median(errors[:, 1]) < 0.25


@pytest.mark.data
def test_the_constant_is_what_the_two_conventions_say(poses: tuple[Poses, Poses]) -> None:
    """Theirs is a quarter turn about the sheet's normal, at the corner across (markers of 95.5, gaps of 25.5 mm)."""
    constant = constant_between(*poses)
    corner = (4 * 0.0955 + 3 * 0.0255, -(3 * 0.0955 + 2 * 0.0255), 0)
    quarter = np.eye(4)
    quarter[:3, :3], quarter[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], corner
    metres, degrees = pose_difference(constant, quarter)
    assert metres < 0.01
    assert degrees < 1
