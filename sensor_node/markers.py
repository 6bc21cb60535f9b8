"""Pose of the camera from the marker board: ArUco and AprilTag grids, ChArUco boards, single markers."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import BoardPose
from deltalight.protocol.poses import rigid_matrix
from deltalight.sensor_node.marker_finder import (
    MarkerFinder,
    Quads,
    linear_luminance,
    planar_poses,
    shortest_sides,
)

# Corners with larger residuals, and above three times the median, are occluded and left out.
OUTLIER_PX, OUTLIER_MEDIANS = 1.5, 3.0
# A detection with a larger mean reprojection error is a mistake: another board, or wrong calibration.
MAX_ERROR_PX = 8.0
# Solutions of the planar ambiguity are told apart by history if their errors, each with the noise of a corner added,
# differ by less than this factor.
AMBIGUOUS_RATIO, CORNER_NOISE_PX = 1.5, 0.05
# A quad is the marker expected there if no corner is farther off: less than the inner edge of the border (1/6 of
# the side away in either direction) of what can be read.
NEAR_PX, NEAR_FRACTION = 1.0, 0.1


class _Matches(NamedTuple):
    """Board corners that were found: in the world, in the picture, and as a pinhole would see them."""

    world: Float64[np.ndarray, "n 3"]
    pixels: Float64[np.ndarray, "n 2"]
    rays: Float64[np.ndarray, "n 2"]

    def only(self, kept: Bool[np.ndarray, " n"]) -> "_Matches":
        return _Matches(*(values[kept] for values in self))

    def with_(self, others: "_Matches") -> "_Matches":
        return _Matches(*(np.concatenate(both) for both in zip(self, others, strict=True)))


class _Solution(NamedTuple):
    """One pose with its mean reprojection error in pixels."""

    camera_from_world: Float64[np.ndarray, "4 4"]
    error_px: float


class BoardDetector:
    """Detects one board in the pictures of one camera, and remembers the last pose to resolve ambiguity.

    Corners are refined on linear light: gamma pulls the black edges of a blurred marker inward. The pose is that of
    docs/formats.md 3's board frame.
    """

    def __init__(
        self,
        board: BoardSpec,
        camera: CameraModel,
        response: Float32[np.ndarray, "256 3"] | None = None,
    ) -> None:
        self._board, self._camera = board, camera
        self._response, self._finder = response, MarkerFinder(board)
        self._corners = board.corner_points()
        self._chessboard = board.chessboard_corners()
        self._previous: Float64[np.ndarray, "4 4"] | None = None

    def detect(
        self, color: UInt8[np.ndarray, "h w 3"], region: tuple[slice, slice] | None = None
    ) -> BoardPose | None:
        """Returns the pose in a picture (RGB), or None if the board is not visible.

        `reprojection_error_px` is the mean distance between the corners found and the board's corners.

        Args:
            color: the picture.
            region: rows and columns to search; None = all.

        Raises:
            DeltalightError: the picture has not the camera's size.
        """
        self.require_size(color)
        matches = self._find(color, region)
        solutions = [] if matches is None else self._solve_seen(matches)
        if not solutions:
            return None
        best, other = self._choose(solutions)
        self._previous = np.linalg.inv(best.camera_from_world)
        alternative = None if other is None else np.linalg.inv(other.camera_from_world)
        return BoardPose(self._previous, best.error_px, alternative)

    def require_size(self, color: UInt8[np.ndarray, "h w 3"]) -> None:
        """Checks that a picture is of the camera's size.

        Raises:
            DeltalightError: it is not.
        """
        if color.shape[:2] != (self._camera.height, self._camera.width):
            raise DeltalightError(
                f"the picture has {color.shape[1]}x{color.shape[0]} pixels but its camera "
                f"{self._camera.width}x{self._camera.height}; correct calibration/rgb.yaml."
            )

    def corners_at(self, world_from_camera: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "n 2"]:
        """Returns where a camera sees the corners of all markers, in the picture or not; NaN behind it."""
        world = np.concatenate(list(self._corners.values()))
        return self._projected(np.linalg.inv(world_from_camera), world)

    def _find(
        self, color: UInt8[np.ndarray, "h w 3"], region: tuple[slice, slice] | None = None
    ) -> _Matches | None:
        gray = cv2.cvtColor(np.ascontiguousarray(color), cv2.COLOR_RGB2GRAY)
        quads, unread = self._finder.seen(gray, self._corners, region)
        if not quads:
            return None
        light = linear_luminance(color, self._response)
        if self._board.type == "charuco":
            numbers, pixels = self._finder.inner_corners(gray, light, quads)
            if len(numbers) < 4:
                return None
            return _Matches(self._chessboard[numbers], pixels, self._camera.unproject(pixels))
        matches = self._matched(light, quads)
        others = self._recognized(matches, quads, unread)
        return matches.with_(self._matched(light, others)) if others else matches

    def _matched(self, light: Float32[np.ndarray, "h w"], quads: Quads) -> _Matches:
        """Matches markers' corners, refined."""
        world = np.concatenate([self._corners[name] for name in quads])
        corners = np.array(list(quads.values()))
        pixels = self._finder.refined(light, self._camera, corners).reshape(-1, 2)
        return _Matches(world, pixels, self._camera.unproject(pixels))

    def _recognized(self, matches: _Matches, quads: Quads, unread: Float64[np.ndarray, "n 4 2"]) -> Quads:
        """Returns the quads that lie where the markers that were read place one of the others.

        A small marker is read in some pictures and not in the next: with and without it, a resting camera's pose
        would jump by a pixel.
        """
        solutions = self._solve(matches) if len(unread) else []
        missing = [name for name in self._corners if name not in quads]
        if not solutions or not missing:
            return {}
        places = self._projected(
            solutions[0].camera_from_world, np.array([self._corners[n] for n in missing])
        )
        turned = np.concatenate([np.roll(unread, turn, axis=1) for turn in range(4)])
        found: Quads = {}
        limits = NEAR_PX + NEAR_FRACTION * shortest_sides(places)
        for name, place, limit in zip(missing, places, limits, strict=True):
            misses = np.linalg.norm(turned - place, axis=-1).max(axis=-1)
            nearest = int(misses.argmin())
            if misses[nearest] <= limit:
                found[name] = turned[nearest]
        return found

    def _solve_seen(self, matches: _Matches) -> list[_Solution]:
        """Returns the poses by the corners that are not occluded."""
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
        """Returns both poses of the planar ambiguity, refined, that see the sheet from its printed side."""
        centre = matches.world.mean(axis=0)
        is_square = len(matches.world) == 4 and self._board.type != "charuco"
        solutions = []
        for pose in planar_poses(matches.world - centre, matches.rays, is_square=is_square):
            matrix = pose @ rigid_matrix(np.eye(3), -centre)
            solutions.append(_Solution(matrix, float(self._misses_px(matrix, matches).mean())))
        return sorted(solutions, key=lambda solution: solution.error_px)

    def _misses_px(
        self, camera_from_world: Float64[np.ndarray, "4 4"], matches: _Matches
    ) -> Float64[np.ndarray, " n"]:
        distances = np.linalg.norm(self._projected(camera_from_world, matches.world) - matches.pixels, axis=1)
        return np.asarray(np.nan_to_num(distances, nan=np.inf))

    def _projected(
        self, camera_from_world: Float64[np.ndarray, "4 4"], world: Float64[np.ndarray, "*n 3"]
    ) -> Float64[np.ndarray, "*n 2"]:
        """Returns where points of the world are seen, pixels; NaN behind the camera."""
        points = world.reshape(-1, 3) @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        return self._camera.project(points).reshape(*world.shape[:-1], 2)

    def _choose(self, solutions: list[_Solution]) -> tuple[_Solution, _Solution | None]:
        """Returns the solution with the smaller error; if that is inconclusive, the one nearer to the last pose."""
        best, other = solutions[0], solutions[1] if len(solutions) > 1 else None
        if other is None or self._previous is None:
            return best, other
        if other.error_px + CORNER_NOISE_PX > AMBIGUOUS_RATIO * (best.error_px + CORNER_NOISE_PX):
            return best, other
        turns = [_turn(self._previous, np.linalg.inv(each.camera_from_world)) for each in (best, other)]
        return (best, other) if turns[0] <= turns[1] else (other, best)


def _turn(first: Float64[np.ndarray, "4 4"], second: Float64[np.ndarray, "4 4"]) -> float:
    """Returns the angle between two orientations in radians."""
    return float(np.linalg.norm(cv2.Rodrigues(first[:3, :3].T @ second[:3, :3])[0]))
