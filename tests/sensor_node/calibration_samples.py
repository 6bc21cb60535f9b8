"""Targets seen by known cameras: exact views with noise, and pictures."""

from collections.abc import Callable, Sequence
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.poses import rigid_matrix
from deltalight.sensor_node.calibration.targets import Chessboard
from deltalight.sensor_node.calibration.views import View

Project = Callable[[Float64[np.ndarray, "n 3"]], Float64[np.ndarray, "n 2"]]
SQUARE_M = 0.04
BOARD = Chessboard(8, 6, SQUARE_M)


def facing(
    middle: Float64[np.ndarray, "3"],
    towards: tuple[float, float],
    tilt: tuple[float, float],
    distance: float,
    roll: float,
) -> Float64[np.ndarray, "4 4"]:
    """camera_from_target: its middle at angles `towards` (right, down) of the axis, tilted about both its edges."""
    turn = cv2.Rodrigues(np.array([np.pi, 0.0, 0.0]))[0] @ cv2.Rodrigues(np.array([*tilt, 0.0]))[0]
    turn = cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0] @ turn
    aside = cv2.Rodrigues(np.array([-towards[1], towards[0], 0.0]))[0]
    place = aside @ np.array([0, 0, distance])
    return rigid_matrix(aside @ turn, place - aside @ turn @ middle)


def poses(count: int, reach: tuple[float, float], distance: float) -> list[Float64[np.ndarray, "4 4"]]:
    """Poses all over the field of view (`reach`: angles right and down), tilted in all directions."""
    middle = BOARD.points.mean(axis=0)
    result = []
    for number in range(count):
        angle, share = 2.4 * number, np.sqrt((number + 0.5) / count)
        towards = (reach[0] * share * np.cos(angle), reach[1] * share * np.sin(angle))
        tilt = (0.55 * np.cos(1.9 * number), 0.55 * np.sin(1.9 * number))
        result.append(facing(middle, towards, tilt, distance * (1 + 0.3 * (number % 3)), 0.35 * number))
    return result


def views(
    project: Project,
    size: tuple[int, int],
    placed: Sequence[Float64[np.ndarray, "4 4"]],
    noise_px: float = 0.1,
) -> list[View]:
    """What a camera sees of the chessboard; points outside the picture are left out."""
    random = np.random.default_rng(3)
    gray = np.zeros((size[1], size[0]), np.uint8)
    result = []
    for number, pose in enumerate(placed):
        pixels = project(BOARD.points @ pose[:3, :3].T + pose[:3, 3])
        pixels = pixels + random.normal(0, noise_px, pixels.shape)
        inside = np.all((pixels >= 0) & (pixels <= np.array(size) - 1), axis=1)
        if np.count_nonzero(inside) >= 12:
            numbers = np.flatnonzero(inside)
            result.append(View(f"view {number}", numbers, BOARD.points[inside], pixels[inside], gray, number))
    return result


@cache
def fine_rays(camera: CameraModel) -> Float32[np.ndarray, "h w 3"]:
    fine = camera.resized(2 * camera.width, 2 * camera.height)
    return np.concatenate([fine.rays(), np.ones((fine.height, fine.width, 1), np.float32)], axis=-1)


def picture(camera: CameraModel, pose: Float64[np.ndarray, "4 4"]) -> UInt8[np.ndarray, "h w 3"]:
    """A chessboard on white paper before grey, four samples a pixel."""
    rays = fine_rays(camera)
    normal, offset = pose[:3, 2], pose[:3, 2] @ pose[:3, 3]
    depth = offset / (rays @ normal)
    local = (rays * depth[..., None] - pose[:3, 3]) @ pose[:3, :3] / SQUARE_M
    column, row = local[..., 0], -local[..., 1]
    black = (np.floor(column) + np.floor(row)) % 2 == 0
    squares = (column > -1) & (column < 8) & (row > -1) & (row < 6)
    paper = (column > -1.6) & (column < 8.6) & (row > -1.6) & (row < 6.6) & (depth > 0)
    shade = np.where(paper, np.where(squares & black, 20.0, 225.0), 120.0).astype(np.float32)
    gray = cv2.resize(shade, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.repeat(np.rint(gray).astype(np.uint8)[..., None], 3, axis=-1)
