"""Registration of depth to colour: exact on a synthetic scene, sensible on a real pair of sensors."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage
from deltalight.protocol.poses import rigid_matrix
from deltalight.sensor_node.cameras.synthetic import SyntheticCamera
from deltalight.sensor_node.depth_registration import register_depth

COLOR = CameraModel(320, 240, np.array([[300.0, 0, 160], [0, 300.0, 121], [0, 0, 1]]))
DEPTH = CameraModel(
    256,
    192,
    np.array([[210.0, 0, 127], [0, 210.0, 95], [0, 0, 1]]),
    "plumb_bob",
    np.array([-0.1, 0.02, 0, 0]),
)
TURN = cv2.Rodrigues(np.radians([0.5, -1.0, 0.3]))[0]
COLOR_FROM_DEPTH = rigid_matrix(TURN, [0.05, 0.002, 0.004])


def test_registered_depth_is_what_the_colour_camera_would_measure(synthetic: SyntheticCamera) -> None:
    world_from_color = synthetic.pose_at(20)
    seen = synthetic.scene.trace(DEPTH, world_from_color @ COLOR_FROM_DEPTH).depth_m
    registered = register_depth(DepthImage(seen, seen > 0, DEPTH, 0.002), COLOR, COLOR_FROM_DEPTH)
    truth = synthetic.scene.trace(COLOR, world_from_color).depth_m
    assert registered.camera is COLOR
    assert registered.noise_sigma_m == 0.002
    inside = np.s_[30:-30, 40:-60]
    # No pinholes, although the colour picture is finer; what the box hides from one camera stays unknown.
    assert registered.valid[inside].mean() > 0.97
    error = np.abs(registered.depth_m - truth)[inside][registered.valid[inside]]
    assert np.median(error) < 0.0012
    assert (error < 0.006).mean() > 0.98


def test_the_same_camera_and_no_offset_change_nothing() -> None:
    depth_m = np.full((240, 320), 1.2, np.float32)
    depth_m[50:60, 70:90] = 0
    registered = register_depth(DepthImage(depth_m, depth_m > 0, COLOR), COLOR, np.eye(4))
    np.testing.assert_allclose(registered.depth_m, depth_m, rtol=1e-6)
    np.testing.assert_array_equal(registered.valid, depth_m > 0)


def test_the_nearest_of_two_surfaces_counts() -> None:
    depth_m = np.full((192, 256), 2.0, np.float32)
    depth_m[80:110, 100:130] = 0.5
    camera = CameraModel(256, 192, DEPTH.matrix)
    aside = rigid_matrix(np.eye(3), [0.05, 0, 0])
    registered = register_depth(DepthImage(depth_m, depth_m > 0, camera), camera, aside)
    # Near things move by f * 0.05 / 0.5 = 21 pixels, far ones by 5.25.
    assert (registered.depth_m[82:108, 123:149] == 0.5).all()
    assert not registered.valid[82:108, 107:119].any()
    assert (registered.depth_m[150, 20:] == 2.0).all()


def test_unknown_and_unseen_depth_stays_unknown() -> None:
    empty = np.zeros((192, 256), np.float32)
    assert not register_depth(DepthImage(empty, empty > 0, DEPTH), COLOR, np.eye(4)).valid.any()
    full = np.ones((192, 256), np.float32)
    behind = rigid_matrix(np.diag([-1.0, 1, -1]), [0, 0, 0])
    assert not register_depth(DepthImage(full, full > 0, DEPTH), COLOR, behind).valid.any()


@pytest.mark.data
def test_real_near_depth_comes_to_lie_on_the_near_things(shared_data: Path) -> None:
    folder = shared_data / "rgbd" / "visp_castel_realsense"
    color = cv2.imread(str(folder / "image" / "image_0000.png"), cv2.IMREAD_GRAYSCALE)
    steps = cv2.imread(str(folder / "depth" / "0000.png"), cv2.IMREAD_UNCHANGED)
    assert color is not None
    assert steps is not None
    depth_m = (steps * 0.000124986647).astype(np.float32)
    height, width = color.shape
    color_camera = CameraModel(
        width, height, np.array([[615.167, 0, 312.189], [0, 615.168, 243.437], [0, 0, 1]])
    )
    depth_camera = CameraModel(
        depth_m.shape[1],
        depth_m.shape[0],
        np.array([[476.054, 0, 311.485], [0, 476.053, 246.283], [0, 0, 1]]),
    )
    depth_from_color = np.loadtxt(folder / "depth_M_color.txt")
    raw = DepthImage(depth_m, depth_m > 0, depth_camera)
    registered = register_depth(raw, color_camera, np.linalg.inv(depth_from_color))

    def on_bright_background(depth: DepthImage) -> float:
        """Share of the near surfaces that lie on the windows behind them."""
        return float((color[depth.valid & (depth.depth_m < 0.35)] > 230).mean())

    wrong = register_depth(raw, color_camera, np.eye(4))
    assert on_bright_background(wrong) > 0.005
    assert on_bright_background(registered) < 0.2 * on_bright_background(wrong)
