"""Poses of markers that are fixed to lamps (mode 1 of METHOD 2: a tracked lamp)."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from protocol.board import BoardSpec, LampMarker
from protocol.camera_model import CameraModel
from protocol.frames import LampPose, decode_lut
from protocol.poses import rigid_matrix
from sensor_node.marker_edges import refine_corners
from sensor_node.markers import (
    AMBIGUOUS_RATIO,
    CORNER_NOISE_PX,
    LEAST_SIDE_PX,
    LUMINANCE,
    MAX_ERROR_PX,
    REACH_SHARE,
)


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
    """Return the poses of the board's lamp markers that are seen in a picture, in the board's order.

    A square has two poses that fit nearly as well where it is small or seen from the front. The smaller
    reprojection error decides; where that says little, the pose nearer to the lamp's previous one.

    Args:
        color: picture, RGB, camera-coded.
        board: its `lamp_markers` are looked for.
        camera: camera of the picture.
        response: linear R G B of each code, None = sRGB.
        world_from_camera: pose of the camera, (4, 4), metres.
        previous: what the frame before gave.
    """
    if not board.lamp_markers:
        return ()
    quads = _find(color, board)
    lamps = [lamp for lamp in board.lamp_markers if lamp.id in quads]
    if not lamps:
        return ()
    cells = board.opencv_dictionary().markerSize + 2 * board.border_bits
    light = _linear_luminance(color, response)
    corners = np.array([quads[lamp.id] for lamp in lamps])
    refined = refine_corners(light, camera, corners, REACH_SHARE * board.border_bits / cells)
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


def _find(color: UInt8[np.ndarray, "h w 3"], board: BoardSpec) -> dict[int, Float64[np.ndarray, "4 2"]]:
    """Corners in the picture of every marker that is large enough to be read, by id."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = board.border_bits
    gray = cv2.cvtColor(np.ascontiguousarray(color), cv2.COLOR_RGB2GRAY)
    found, ids, _ = cv2.aruco.ArucoDetector(board.opencv_dictionary(), parameters).detectMarkers(gray)
    quads = [quad.reshape(4, 2).astype(np.float64) for quad in found]
    return {
        int(name): quad
        for quad, name in zip(quads, () if ids is None else ids.ravel(), strict=True)
        if np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).min() >= LEAST_SIDE_PX
    }


def _linear_luminance(
    color: UInt8[np.ndarray, "h w 3"], response: Float32[np.ndarray, "256 3"] | None
) -> Float32[np.ndarray, "h w"]:
    table = (decode_lut(response) * LUMINANCE).astype(np.float32)
    red, green, blue = (table[:, channel][color[..., channel]] for channel in range(3))
    return np.asarray(red + green + blue)


def _solve(lamp: LampMarker, camera: CameraModel, pixels: Float64[np.ndarray, "4 2"]) -> list[_Solution]:
    """Both poses of a square that show its printed side, refined, the better one first."""
    points, rays = lamp.corner_points(), np.ascontiguousarray(camera.unproject(pixels))
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
    except cv2.error:  # corners on one line
        return []
    solutions = []
    for rotation, translation in zip(rotations, translations, strict=True):
        turn, shift = cv2.solvePnPRefineLM(points, rays, np.eye(3), None, rotation, translation)
        matrix = rigid_matrix(cv2.Rodrigues(turn)[0], shift.ravel())
        misses = camera.project(points @ matrix[:3, :3].T + matrix[:3, 3]) - pixels
        error_px = float(np.nan_to_num(np.linalg.norm(misses, axis=1), nan=np.inf).mean())
        if np.linalg.inv(matrix)[2, 3] > 0 and error_px <= MAX_ERROR_PX:
            solutions.append(_Solution(matrix, error_px))
    return sorted(solutions, key=lambda solution: solution.error_px)


def _choose(
    solutions: list[_Solution], expected: Float64[np.ndarray, "4 4"] | None
) -> Float64[np.ndarray, "4 4"] | None:
    """The solution with the smaller error; where that says little, the one turned least from `expected`."""
    if not solutions:
        return None
    limit = AMBIGUOUS_RATIO * (solutions[0].error_px + CORNER_NOISE_PX)
    alike = [each for each in solutions if each.error_px + CORNER_NOISE_PX <= limit]
    if expected is None or len(alike) == 1:
        return solutions[0].camera_from_marker
    # The trace of a relative rotation falls as its angle grows.
    return max(alike, key=lambda each: float(np.sum(each.camera_from_marker[:3, :3] * expected[:3, :3])))[0]
