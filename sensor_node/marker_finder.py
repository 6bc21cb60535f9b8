"""Marker detection in pictures, and the two poses of a flat target, for board, lamps and calibration."""

from collections.abc import Collection, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import LUMINANCE, decode_lut
from deltalight.protocol.poses import rigid_matrix
from deltalight.sensor_node.marker_edges import refine_corners

# Search range from a marker's edge, as a fraction of the border cell or the white gap.
REACH_FRACTION = 0.6
# Half the edge of the window that refines a chessboard corner, as a fraction of the distance to the next marker.
WINDOW_FRACTION = 0.8
WINDOW_HALF_PX = (2, 8)
WINDOW_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 0.005)
# Narrower markers cannot be read.
LEAST_SIDE_PX = 10
# Length of the shortest outline that may be a marker, as a fraction of the picture's longer edge (OpenCV's default).
LEAST_OUTLINE = 0.03

Quads = dict[int, Float64[np.ndarray, "4 2"]]


class FoundMarkers(NamedTuple):
    """Corners of markers that were read, by id, and of quads of which nothing was read (pixels, clockwise)."""

    quads: Quads
    unread: Float64[np.ndarray, "n 4 2"]


class MarkerFinder:
    """Finds the markers of one board's dictionary and refines their corners."""

    def __init__(self, board: BoardSpec) -> None:
        self._board = board

    def quads(self, gray: UInt8[np.ndarray, "h w"], wanted: Collection[int]) -> Quads:
        """Returns the corners of every wanted marker that is large enough to be read, by id."""
        return self.seen(gray, wanted).quads

    def seen(
        self,
        gray: UInt8[np.ndarray, "h w"],
        wanted: Collection[int],
        region: tuple[slice, slice] | None = None,
    ) -> FoundMarkers:
        """Returns the wanted markers that are large enough to be read, and what may be others, of the same size.

        With a `region` (rows, columns), only what lies there, as the search of the whole picture finds it.
        """
        part = gray if region is None else np.ascontiguousarray(gray[region])
        if not part.size:
            return FoundMarkers({}, _stacked(()))
        self._parameters.minMarkerPerimeterRate = LEAST_OUTLINE * max(gray.shape) / max(part.shape)
        self._detector.setDetectorParameters(self._parameters)
        found, ids, others = self._detector.detectMarkers(part)
        names = [] if ids is None else ids.ravel().tolist()
        corner = (0, 0) if region is None else (region[1].start, region[0].start)
        quads, unread = _stacked(found) + corner, _stacked(others) + corner
        read = zip(names, quads, shortest_sides(quads), strict=True)
        return FoundMarkers(
            {name: quad for name, quad, side in read if name in wanted and side >= LEAST_SIDE_PX},
            unread[shortest_sides(unread) >= LEAST_SIDE_PX],
        )

    def refined(
        self, light: Float32[np.ndarray, "h w"], camera: CameraModel, corners: Float64[np.ndarray, "n 4 2"]
    ) -> Float64[np.ndarray, "n 4 2"]:
        """Returns the corners of the board's markers: intersections of lines fitted to their edges (linear light)."""
        board = self._board
        thin = min(self.border_fraction, board.separation_m / board.marker_length_m or 1.0)
        return refine_corners(light, camera, corners, REACH_FRACTION * thin)

    @property
    def border_fraction(self) -> float:
        """Width of the black border as a fraction of a marker's edge."""
        cells = self._board.opencv_dictionary().markerSize + 2 * self._board.border_bits
        return float(self._board.border_bits / cells)

    def inner_corners(
        self, gray: UInt8[np.ndarray, "h w"], light: np.ndarray, quads: Quads
    ) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 2"]]:
        """Returns indices and pixels of a ChArUco board's inner corners, refined on `light`."""
        markers = [quad[None].astype(np.float32) for quad in quads.values()]
        names = np.array([[name] for name in quads], np.int32)
        corners, ids, _, _ = self._charuco.detectBoard(gray, markerCorners=markers, markerIds=names)
        if ids is None:
            return np.zeros(0, np.int64), np.zeros((0, 2))
        # The window must not reach the markers, which begin half a separation away.
        side = float(shortest_sides(np.array(list(quads.values()))).min())
        gap = side * self._board.separation_m / self._board.marker_length_m / 2
        half = int(np.clip(round(WINDOW_FRACTION * gap), *WINDOW_HALF_PX))
        start = np.ascontiguousarray(corners, np.float32).reshape(-1, 1, 2)
        pixels = cv2.cornerSubPix(light, start, (half, half), (-1, -1), WINDOW_CRITERIA)
        return ids.ravel().astype(np.int64), pixels.reshape(-1, 2).astype(np.float64)

    @cached_property
    def _detector(self) -> Any:  # noqa: ANN401 - cv2 has no types
        return cv2.aruco.ArucoDetector(self._board.opencv_dictionary(), self._parameters)

    @cached_property
    def _parameters(self) -> Any:  # noqa: ANN401 - cv2 has no types
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = self._board.border_bits
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
        return parameters

    @cached_property
    def _charuco(self) -> Any:  # noqa: ANN401 - cv2 has no types
        board = self._board
        square = board.marker_length_m + board.separation_m
        size, ids = (board.columns, board.rows), np.array(board.marker_ids)
        return cv2.aruco.CharucoDetector(
            cv2.aruco.CharucoBoard(size, square, board.marker_length_m, board.opencv_dictionary(), ids)
        )


def _stacked(found: Sequence[np.ndarray]) -> Float64[np.ndarray, "n 4 2"]:
    return np.array(found, np.float64).reshape(-1, 4, 2)


def shortest_sides(quads: Float64[np.ndarray, "*n 4 2"]) -> Float64[np.ndarray, " *n"]:
    """Returns the shortest side of each quad, in pixels."""
    return np.asarray(np.linalg.norm(quads - np.roll(quads, 1, axis=-2), axis=-1).min(axis=-1))


def linear_luminance(
    color: UInt8[np.ndarray, "h w 3"], response: Float32[np.ndarray, "256 3"] | None
) -> Float32[np.ndarray, "h w"]:
    """Returns the linear luminance of a coded picture: a sum of three look-ups."""
    table = (decode_lut(response) * LUMINANCE).astype(np.float32)
    planes = cv2.split(color)
    red, green, blue = (cv2.LUT(plane, table[:, channel]) for channel, plane in enumerate(planes))
    return np.asarray(red + green + blue)


def planar_poses(
    points: Float64[np.ndarray, "n 3"], rays: Float64[np.ndarray, "n 2"], *, is_square: bool
) -> list[Float64[np.ndarray, "4 4"]]:
    """Returns both poses (camera from target) of the planar ambiguity, refined, that show the printed side.

    Args:
        points: in the plane z = 0 of the target, whose printed side is towards +z; about the origin.
        rays: where they are seen, (x/z, y/z).
        is_square: they are the corners of a square in OpenCV's order.
    """
    method = cv2.SOLVEPNP_IPPE_SQUARE if is_square else cv2.SOLVEPNP_IPPE
    points, rays = np.ascontiguousarray(points), np.ascontiguousarray(rays)
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(points, rays, np.eye(3), None, flags=method)
    except cv2.error:  # corners on one line
        return []
    poses = []
    for rotation, translation in zip(rotations, translations, strict=True):
        turn, shift = cv2.solvePnPRefineLM(points, rays, np.eye(3), None, rotation, translation)
        poses.append(rigid_matrix(cv2.Rodrigues(turn)[0], shift.ravel()))
    return [pose for pose in poses if np.linalg.inv(pose)[2, 3] > 0]
