"""Finds the board in the pictures of a live camera, one after another, by what the last picture told."""

from typing import NamedTuple, Self

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from deltalight.protocol.frames import BoardPose
from deltalight.sensor_node.markers import BoardDetector
from deltalight.sensor_node.resting_board import RestingBoard

# After so many pictures of a resting board it is searched again, so that no fault of a detection stays.
MOST_REUSED = 30
# A moving board is searched within its last place and this much around, in pixels and of its size.
MARGIN_PX, MARGIN_FRACTION = 24, 0.15
# It was found there for certain if its place is this far within: markers are made out against their surroundings.
LEAST_MARGIN_PX = 12


class BoardTracker:
    """Gives the poses of one board, for as little as the pictures allow.

    A board that rests in the picture keeps its pose; how sure that is, `RestingBoard` says. Otherwise the board is
    detected as in a single picture, around its last place first. The pose never comes from motion or prediction, so
    it neither lags nor drifts.
    """

    def __init__(self, detector: BoardDetector) -> None:
        self._detector = detector
        self._last: BoardPose | None = None
        self._resting: RestingBoard | None = None
        self._reused = 0

    def detect(self, color: UInt8[np.ndarray, "h w 3"]) -> BoardPose | None:
        """Returns the pose in the next picture (RGB), or None if the board is not visible.

        Raises:
            DeltalightError: the picture has not the camera's size.
        """
        self._detector.require_size(color)
        gray = cv2.cvtColor(np.ascontiguousarray(color), cv2.COLOR_RGB2GRAY)
        if self._resting is not None and self._reused < MOST_REUSED and self._resting.rests_in(gray):
            self._reused += 1
            return self._last
        self._last = self._detected(color)
        self._reused = 0
        self._resting = None if self._last is None else RestingBoard(gray, self._corners(self._last))
        return self._last

    def _detected(self, color: UInt8[np.ndarray, "h w 3"]) -> BoardPose | None:
        """Searches around the last place, and in the whole picture unless all of the board lies well within."""
        if self._last is not None:
            region = _Region.around(self._corners(self._last), color.shape, MARGIN_PX, MARGIN_FRACTION)
            pose = self._detector.detect(color, region.slices)
            if pose is not None and region.holds(
                _Region.around(self._corners(pose), color.shape, LEAST_MARGIN_PX)
            ):
                return pose
        return self._detector.detect(color)

    def _corners(self, pose: BoardPose) -> Float64[np.ndarray, "n 2"]:
        return self._detector.corners_at(pose.world_from_camera)


class _Region(NamedTuple):
    """A rectangle of a picture, whole pixels; ends are not part of it."""

    top: int
    bottom: int
    left: int
    right: int

    @classmethod
    def around(
        cls,
        corners: Float64[np.ndarray, "n 2"],
        shape: tuple[int, ...],
        margin_px: float,
        fraction: float = 0.0,
    ) -> Self:
        """Returns what a picture of a shape shows around points; all of it around points that it cannot show."""
        height, width = shape[:2]
        if not np.isfinite(corners).all():
            return cls(0, height, 0, width)
        low, high = corners.min(axis=0), corners.max(axis=0)
        margin = margin_px + fraction * (high - low)
        (left, top), (right, bottom) = np.clip((low - margin, high + margin), 0, (width, height)).tolist()
        return cls(int(top), int(bottom), int(left), int(right))

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def holds(self, other: "_Region") -> bool:
        return (
            self.top <= other.top
            and other.bottom <= self.bottom
            and self.left <= other.left
            and other.right <= self.right
        )
