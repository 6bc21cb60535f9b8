"""Pose of the depth sensor: the plane that it measures on the marker board must be the board's plane."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage, SensorFrame
from deltalight.protocol.poses import rigid_matrix
from deltalight.sensor_node.markers import BoardDetector

Pose = Float64[np.ndarray, "4 4"]
# Only depth well inside the board's outline is used: at its border it may be the table's.
INSIDE_FRACTION = 0.9
# Points farther from the board's plane lie on something else.
NEAR_M = 0.05
LEAST_POINTS = 200
# Per depth image: enough for some thousand points on a board a fifth of the width.
MOST_POINTS = 40_000
# Three tilts determine a transform; more show whether they agree.
LEAST_VIEWS = 6
ROUNDS = 20
# A hundredth of a millimetre, or of a milliradian, is below the accuracy of depth.
DONE = 1e-5
# Above this uncertainty the board's tilts did not determine the transform: more than a pixel at VGA and 1 m.
MOST_SIGMA_M, MOST_SIGMA_DEG = 0.004, 0.3
MOST_RMS_M = 0.01


class DepthView(NamedTuple):
    """One frame: the pose of the colour camera by the board, and its depth."""

    world_from_camera: Pose
    depth: DepthImage


class DepthPlacement(NamedTuple):
    """depth_from_rgb with the rms distance of the planes and the standard deviations of the transform."""

    transform: Pose
    views: int
    rms_m: float
    sigma_m: float
    sigma_deg: float


def depth_views(frames: Iterable[SensorFrame], board: BoardSpec) -> Iterator[DepthView]:
    """Yields the frames with depth in which the colour camera sees the board."""
    detector = None
    for frame in frames:
        detector = detector or BoardDetector(board, frame.camera, frame.response)
        pose = None if frame.depth is None else detector.detect(frame.color)
        if frame.depth is not None and pose is not None:
            yield DepthView(pose.world_from_camera, frame.depth)


def place_depth_sensor(views: Iterable[DepthView], board: BoardSpec, start: Pose) -> DepthPlacement:
    """Returns the depth_from_rgb that puts the measured planes into the board's plane, by Gauss-Newton.

    Each view counts as four points of the plane fitted to its depth, because depth errors are common to a picture.

    Args:
        views: frames with the board tilted in different directions.
        board: the board.
        start: initial depth_from_rgb; the identity if the sensors are side by side.

    Raises:
        DeltalightError: there are too few views, or their tilts do not determine the transform.
    """
    listed = [(view, _points(view.depth)) for view in views]
    rgb_from_depth = np.linalg.inv(start)
    for _ in range(ROUNDS):
        patches = [(view, _patch(points, view, board, rgb_from_depth)) for view, points in listed]
        seen = [(view, patch) for view, patch in patches if patch is not None]
        if len(seen) < LEAST_VIEWS:
            raise DeltalightError(
                f"the depth sensor shows the board in only {len(seen)} views, and {LEAST_VIEWS} are needed; record"
                " it from 0.4 to 1.5 m at different tilts, or begin with a rough depth_from_rgb in extrinsics.yaml."
            )
        rows, misses = _equations(seen, rgb_from_depth)
        turn, shift = np.split(np.linalg.lstsq(rows, -misses, rcond=None)[0], 2)
        rgb_from_depth = rigid_matrix(cv2.Rodrigues(turn)[0], shift) @ rgb_from_depth
        if np.abs(turn).max() < DONE and np.abs(shift).max() < DONE:
            break
    return _checked(rows, misses, rgb_from_depth, len(seen))


def _equations(
    seen: list[tuple[DepthView, Float64[np.ndarray, "4 3"]]], rgb_from_depth: Pose
) -> tuple[Float64[np.ndarray, "m 6"], Float64[np.ndarray, " m"]]:
    """Returns the heights of the patches' points over the board, and their derivatives by the sensor's motion."""
    rows, misses = [], []
    for view, patch in seen:
        points = patch @ rgb_from_depth[:3, :3].T + rgb_from_depth[:3, 3]
        normal, height = view.world_from_camera[2, :3], view.world_from_camera[2, 3]
        rows.append(np.column_stack([np.cross(points, normal), np.tile(normal, (4, 1))]))
        misses.append(points @ normal + height)
    return np.concatenate(rows), np.concatenate(misses)


def _points(depth: DepthImage) -> Float64[np.ndarray, "n 3"]:
    """Returns some of the points of a depth image, in its camera's frame, evenly over the image."""
    step = int(np.ceil(np.sqrt(depth.depth_m.size / MOST_POINTS)))
    few = (slice(None, None, step), slice(None, None, step))
    known = (depth.valid & (depth.depth_m > 0))[few]
    z = depth.depth_m[few][known].astype(np.float64)
    return np.column_stack([depth.camera.rays()[few][known] * z[:, None], z])


def _patch(
    points: Float64[np.ndarray, "n 3"], view: DepthView, board: BoardSpec, rgb_from_depth: Pose
) -> Float64[np.ndarray, "4 3"] | None:
    """Returns four corners (in the depth sensor's frame) of the plane measured on the board."""
    placed = view.world_from_camera @ rgb_from_depth
    world = points @ placed[:3, :3].T + placed[:3, 3]
    outline = board.sheet_outline()
    middle, half = outline.mean(axis=0), np.ptp(outline, axis=0) / 2
    inside = np.all(np.abs(world - middle)[:, :2] < INSIDE_FRACTION * half[:2], axis=1)
    on_board = points[inside & (np.abs(world[:, 2]) < NEAR_M)]
    if len(on_board) < LEAST_POINTS:
        return None
    variances, axes = np.linalg.eigh(np.cov(on_board.T))
    # The half edge of a uniform patch is its standard deviation times the square root of three.
    edges = axes.T[1:] * np.sqrt(3 * variances[1:, None])
    return np.array([on_board.mean(axis=0) + a * edges[0] + b * edges[1] for a in (-1, 1) for b in (-1, 1)])


def _checked(
    rows: Float64[np.ndarray, "m 6"], misses: Float64[np.ndarray, " m"], rgb_from_depth: Pose, views: int
) -> DepthPlacement:
    rms = float(np.sqrt(np.mean(misses**2)))
    variance = np.sum(misses**2) / max(len(misses) - 6, 1)
    # A millimetre is the least error of a depth sensor.
    sigmas = np.sqrt(np.diag(np.linalg.pinv(rows.T @ rows, hermitian=True)) * max(variance, 1e-6))
    rank = np.linalg.matrix_rank(rows, tol=1e-6 * np.linalg.norm(rows))
    sigma_deg, sigma_m = float(np.degrees(sigmas[:3].max())), float(sigmas[3:].max())
    if rank < 6 or sigma_m > MOST_SIGMA_M or sigma_deg > MOST_SIGMA_DEG:
        raise DeltalightError(
            f"the board's tilts leave depth_from_rgb uncertain by {1e3 * sigma_m:.1f} mm and {sigma_deg:.2f} degrees;"
            " record it tilted by 20 to 45 degrees to the left, right, front and back."
        )
    if rms > MOST_RMS_M:
        raise DeltalightError(
            f"depth and colour disagree about the board by {1e3 * rms:.1f} mm rms; check depth_scale in "
            "calibration/depth.yaml, the size of the printed markers and both lenses."
        )
    return DepthPlacement(np.linalg.inv(rgb_from_depth), views, rms, sigma_m, sigma_deg)
