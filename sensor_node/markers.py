"""Pose of the camera from the marker board: ArUco and AprilTag grids, ChArUco boards, single markers."""

from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from protocol.board import BoardSpec
from protocol.camera_model import CameraModel
from protocol.errors import DeltalightError
from protocol.frames import BoardPose, decode_lut
from protocol.poses import rigid_matrix
from sensor_node.marker_edges import refine_corners

# How far from a marker's edge it is looked for, as a share of the border cell or the white gap.
REACH_SHARE = 0.6
# Half the edge of the window that refines a chessboard corner, as a share of the way to the next marker.
WINDOW_SHARE = 0.8
WINDOW_HALF_PX = (2, 8)
WINDOW_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 0.005)
# Corners that miss by more than this and three times the median are hidden by something, and left out.
OUTLIER_PX, OUTLIER_MEDIANS = 1.5, 3.0
# Markers narrower than this cannot be read.
LEAST_SIDE_PX = 10
# A detection whose mean reprojection error is larger is a mistake: another board, or wrong calibration.
MAX_ERROR_PX = 8.0
# Solutions of the planar ambiguity are told apart by history where their errors, each with the noise of a
# corner added, differ by less than this factor.
AMBIGUOUS_RATIO, CORNER_NOISE_PX = 1.5, 0.05
LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


class _Matches(NamedTuple):
    """Board corners that were found: in the world, in the picture, and as a pinhole would see them."""

    world: Float64[np.ndarray, "n 3"]
    pixels: Float64[np.ndarray, "n 2"]
    rays: Float64[np.ndarray, "n 2"]

    def only(self, kept: Bool[np.ndarray, " n"]) -> "_Matches":
        return _Matches(*(values[kept] for values in self))


class _Solution(NamedTuple):
    """One pose with its mean reprojection error in pixels."""

    camera_from_world: Float64[np.ndarray, "4 4"]
    error_px: float


class BoardDetector:
    """Finds one board in the pictures of one camera, and remembers the last pose to resolve ambiguity.

    Corners are refined on linear light: gamma pulls the black edges of a blurred marker inward. The pose is
    the board frame's of FORMATS 3.
    """

    def __init__(
        self,
        board: BoardSpec,
        camera: CameraModel,
        response: Float32[np.ndarray, "256 3"] | None = None,
    ) -> None:
        self._board, self._camera = board, camera
        # One table a channel, so that linear luminance is a sum of three look-ups.
        self._luminance = (decode_lut(response) * LUMINANCE).astype(np.float32)
        self._corners = board.corner_points()
        self._chessboard = board.chessboard_corners()
        self._previous: Float64[np.ndarray, "4 4"] | None = None

    def detect(self, color: UInt8[np.ndarray, "h w 3"]) -> BoardPose | None:
        """Return the pose in a picture (RGB), or None where the board is not seen.

        `reprojection_error_px` is the mean distance between the corners found and the board's corners.

        Raises:
            DeltalightError: the picture is not of the camera's size.
        """
        if color.shape[:2] != (self._camera.height, self._camera.width):
            raise DeltalightError(
                f"the picture has {color.shape[1]}x{color.shape[0]} pixels but its camera "
                f"{self._camera.width}x{self._camera.height}; correct calibration/rgb.yaml."
            )
        matches = self._find(color)
        solutions = [] if matches is None else self._solve_seen(matches)
        if not solutions:
            return None
        best, other = self._choose(solutions)
        self._previous = np.linalg.inv(best.camera_from_world)
        alternative = None if other is None else np.linalg.inv(other.camera_from_world)
        return BoardPose(self._previous, best.error_px, alternative)

    @cached_property
    def _detector(self) -> Any:  # noqa: ANN401 - cv2 has no types
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = self._board.border_bits
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
        return cv2.aruco.ArucoDetector(self._board.opencv_dictionary(), parameters)

    @cached_property
    def _charuco(self) -> Any:  # noqa: ANN401 - cv2 has no types
        board = self._board
        square = board.marker_length_m + board.separation_m
        size, ids = (board.columns, board.rows), np.array(board.marker_ids)
        return cv2.aruco.CharucoDetector(
            cv2.aruco.CharucoBoard(size, square, board.marker_length_m, board.opencv_dictionary(), ids)
        )

    def _find(self, color: UInt8[np.ndarray, "h w 3"]) -> _Matches | None:
        gray = cv2.cvtColor(np.ascontiguousarray(color), cv2.COLOR_RGB2GRAY)
        found, ids, _ = self._detector.detectMarkers(gray)
        quads = {
            int(name): quad.reshape(4, 2).astype(np.float64)
            for quad, name in zip(found, () if ids is None else ids.ravel(), strict=True)
            if int(name) in self._corners and _shortest_side(quad.reshape(4, 2)) >= LEAST_SIDE_PX
        }
        if not quads:
            return None
        light = self._linear_luminance(color)
        if self._board.type == "charuco":
            world, pixels = self._chessboard_corners(gray, light, quads)
        else:
            world, pixels = self._marker_corners(light, quads)
        if len(world) < 4:
            return None
        return _Matches(world, pixels, self._camera.unproject(pixels))

    def _marker_corners(
        self, light: Float32[np.ndarray, "h w"], quads: dict[int, Float64[np.ndarray, "4 2"]]
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 2"]]:
        """Corners of markers in the world and in the picture."""
        board, corners = self._board, np.array(list(quads.values()))
        cells = board.opencv_dictionary().markerSize + 2 * board.border_bits
        thin = min(board.border_bits / cells, board.separation_m / board.marker_length_m or 1.0)
        world = np.concatenate([self._corners[name] for name in quads])
        return world, refine_corners(light, self._camera, corners, REACH_SHARE * thin).reshape(-1, 2)

    def _chessboard_corners(
        self,
        gray: UInt8[np.ndarray, "h w"],
        light: Float32[np.ndarray, "h w"],
        quads: dict[int, Float64[np.ndarray, "4 2"]],
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 2"]]:
        """Inner corners of a ChArUco board in the world and in the picture."""
        markers = [quad[None].astype(np.float32) for quad in quads.values()]
        names = np.array([[name] for name in quads], np.int32)
        corners, ids, _, _ = self._charuco.detectBoard(gray, markerCorners=markers, markerIds=names)
        if ids is None:
            return np.zeros((0, 3)), np.zeros((0, 2))
        # The window must not reach the markers, which begin half a separation away.
        side = min(_shortest_side(quad) for quad in quads.values())
        gap = side * self._board.separation_m / self._board.marker_length_m / 2
        half = int(np.clip(round(WINDOW_SHARE * gap), *WINDOW_HALF_PX))
        start = np.ascontiguousarray(corners, np.float32).reshape(-1, 1, 2)
        pixels = cv2.cornerSubPix(light, start, (half, half), (-1, -1), WINDOW_CRITERIA)
        return self._chessboard[ids.ravel()], pixels.reshape(-1, 2).astype(np.float64)

    def _linear_luminance(self, color: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
        red, green, blue = (self._luminance[:, channel][color[..., channel]] for channel in range(3))
        return np.asarray(red + green + blue)

    def _solve_seen(self, matches: _Matches) -> list[_Solution]:
        """Poses by the corners that nothing hides."""
        solutions = self._solve(matches)
        if not solutions:
            return []
        misses = self._misses_px(solutions[0].camera_from_world, matches)
        kept = misses <= max(OUTLIER_PX, OUTLIER_MEDIANS * float(np.median(misses)))
        if kept.all() or np.count_nonzero(kept) < 4:
            return self._plausible(solutions)
        return self._plausible(self._solve(matches.only(kept)))

    @staticmethod
    def _plausible(solutions: list[_Solution]) -> list[_Solution]:
        return [solution for solution in solutions if solution.error_px <= MAX_ERROR_PX]

    def _solve(self, matches: _Matches) -> list[_Solution]:
        """Both poses of the planar ambiguity, refined, that see the sheet from its printed side."""
        centre = matches.world.mean(axis=0)
        points = np.ascontiguousarray(matches.world - centre)
        image = np.ascontiguousarray(matches.rays)
        single = len(points) == 4 and self._board.type != "charuco"
        method = cv2.SOLVEPNP_IPPE_SQUARE if single else cv2.SOLVEPNP_IPPE
        try:
            _, rotations, translations, _ = cv2.solvePnPGeneric(points, image, np.eye(3), None, flags=method)
        except cv2.error:  # corners on one line
            return []
        solutions = []
        for rotation, translation in zip(rotations, translations, strict=True):
            turn, shift = cv2.solvePnPRefineLM(points, image, np.eye(3), None, rotation, translation)
            matrix = rigid_matrix(cv2.Rodrigues(turn)[0], shift.ravel())
            matrix = matrix @ rigid_matrix(np.eye(3), -centre)
            if np.linalg.inv(matrix)[2, 3] > 0:
                solutions.append(_Solution(matrix, float(self._misses_px(matrix, matches).mean())))
        return sorted(solutions, key=lambda solution: solution.error_px)

    def _misses_px(
        self, camera_from_world: Float64[np.ndarray, "4 4"], matches: _Matches
    ) -> Float64[np.ndarray, " n"]:
        points = matches.world @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        distances = np.linalg.norm(self._camera.project(points) - matches.pixels, axis=1)
        return np.asarray(np.nan_to_num(distances, nan=np.inf))

    def _choose(self, solutions: list[_Solution]) -> tuple[_Solution, _Solution | None]:
        """The solution with the smaller error; where that says little, the one nearer to the last pose."""
        best, other = solutions[0], solutions[1] if len(solutions) > 1 else None
        if other is None or self._previous is None:
            return best, other
        if other.error_px + CORNER_NOISE_PX > AMBIGUOUS_RATIO * (best.error_px + CORNER_NOISE_PX):
            return best, other
        turns = [_turn(self._previous, np.linalg.inv(each.camera_from_world)) for each in (best, other)]
        return (best, other) if turns[0] <= turns[1] else (other, best)


def _shortest_side(quad: Float64[np.ndarray, "4 2"]) -> float:
    return float(np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).min())


def _turn(first: Float64[np.ndarray, "4 4"], second: Float64[np.ndarray, "4 4"]) -> float:
    """Angle between two orientations in radians."""
    return float(np.linalg.norm(cv2.Rodrigues(first[:3, :3].T @ second[:3, :3])[0]))
