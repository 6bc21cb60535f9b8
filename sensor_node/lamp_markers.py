"""Poses of markers that are fixed to lamps (mode 1 of docs/method.md 2: a tracked lamp)."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from deltalight.protocol.board import BoardSpec, LampMarker
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import LampPose
from deltalight.sensor_node.marker_edges import refine_corners
from deltalight.sensor_node.marker_finder import REACH_FRACTION, MarkerFinder, linear_luminance, planar_poses
from deltalight.sensor_node.markers import AMBIGUOUS_RATIO, CORNER_NOISE_PX, MAX_ERROR_PX


class _Solution(NamedTuple):
    """One pose of a marker with its mean reprojection error in pixels."""

    camera_from_marker: Float64[np.ndarray, "4 4"]
    error_px: float


def detect_lamps(
    color: UInt8[np.ndarray, "h w 3"],
    board: BoardSpec,
    camera: CameraModel,
    response: Float32[np.ndarray, "256 3"] | None,
    world_from_camera: Float64[np.ndarray, "4 4"],
    *,
    previous: Sequence[LampPose] = (),
) -> tuple[LampPose, ...]:
    """Returns the poses of the board's lamp markers that a picture shows, in the board's order.

    A square has two poses that fit nearly equally well if it is small or seen from the front. The smaller
    reprojection error decides; if that is inconclusive, the pose nearer to the lamp's previous one.

    Args:
        color: picture, RGB, camera-coded.
        board: its `lamp_markers` are searched.
        camera: camera of the picture.
        response: linear R G B of each code, None = sRGB.
        world_from_camera: pose of the camera, (4, 4), metres.
        previous: result of the previous frame.
    """
    if not board.lamp_markers:
        return ()
    finder = MarkerFinder(board)
    gray = cv2.cvtColor(np.ascontiguousarray(color), cv2.COLOR_RGB2GRAY)
    quads = finder.quads(gray, [lamp.id for lamp in board.lamp_markers])
    lamps = [lamp for lamp in board.lamp_markers if lamp.id in quads]
    if not lamps:
        return ()
    light = linear_luminance(color, response)
    corners = np.array([quads[lamp.id] for lamp in lamps])
    refined = refine_corners(light, camera, corners, REACH_FRACTION * finder.border_fraction)
    before = {pose.marker: pose.world_from_marker for pose in previous}
    camera_from_world = np.linalg.inv(world_from_camera)
    poses = []
    for lamp, pixels in zip(lamps, refined, strict=True):
        last = before.get(lamp.id)
        expected = None if last is None else camera_from_world @ last
        found = _choose(_solve(lamp, camera, pixels), expected)
        if found is not None:
            poses.append(LampPose(lamp.id, world_from_camera @ found))
    return tuple(poses)


def _solve(lamp: LampMarker, camera: CameraModel, pixels: Float64[np.ndarray, "4 2"]) -> list[_Solution]:
    """Returns both poses of a square that show its printed side, refined, the better one first."""
    points, solutions = lamp.corner_points(), []
    for matrix in planar_poses(points, camera.unproject(pixels), is_square=True):
        misses = camera.project(points @ matrix[:3, :3].T + matrix[:3, 3]) - pixels
        error_px = float(np.nan_to_num(np.linalg.norm(misses, axis=1), nan=np.inf).mean())
        if error_px <= MAX_ERROR_PX:
            solutions.append(_Solution(matrix, error_px))
    return sorted(solutions, key=lambda solution: solution.error_px)


def _choose(
    solutions: list[_Solution], expected: Float64[np.ndarray, "4 4"] | None
) -> Float64[np.ndarray, "4 4"] | None:
    """Returns the solution with the smaller error; if that is inconclusive, the one rotated least from `expected`."""
    if not solutions:
        return None
    limit = AMBIGUOUS_RATIO * (solutions[0].error_px + CORNER_NOISE_PX)
    alike = [each for each in solutions if each.error_px + CORNER_NOISE_PX <= limit]
    if expected is None or len(alike) == 1:
        return solutions[0].camera_from_marker
    # The trace of a relative rotation falls as its angle grows.
    return max(alike, key=lambda each: float(np.sum(each.camera_from_marker[:3, :3] * expected[:3, :3])))[0]
