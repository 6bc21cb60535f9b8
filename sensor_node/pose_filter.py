"""Smoothing of the camera pose: the One-Euro filter (Casiez, Roussel and Vogel, CHI 2012) on a rigid motion.

The filter runs on camera_from_world, the board as seen by the camera: there the noise of the translation is that of
the corners, while the camera's own position also swings with every error of the rotation.
"""

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64
from pydantic import Field

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.frames import BoardPose
from deltalight.protocol.poses import rigid_matrix

# Cut-off of the speed estimate, Hz, as in the paper.
SPEED_CUTOFF_HZ = 1.0
# The filter restarts if a pose comes later than this after the last: two frames of the slowest useful stream.
GAP_S = 0.5
# No hand moves or turns a camera faster: such a step is a correction (the other planar solution, another board).
JUMP_M_PER_S, JUMP_RAD_PER_S = 5.0, 10.0


class PoseFilterSettings(StrictModel):
    """How strongly poses are smoothed."""

    min_cutoff_hz: float = Field(
        default=1.0, gt=0, le=1000, description="Cut-off at rest, Hz: lower is steadier and slower."
    )
    beta: float = Field(
        default=16.0,
        ge=0,
        le=1e4,
        description="Rise of the cut-off with speed, Hz for 1 m/s and for 1 rad/s; lag stays below 1/(2 pi beta).",
    )


class _State(NamedTuple):
    """Last input and output pose (camera_from_world), and the speeds of the board."""

    timestamp_ns: int
    measured: Float64[np.ndarray, "4 4"]
    smooth: Float64[np.ndarray, "4 4"]
    velocity: Float64[np.ndarray, "3"]
    turn_rate: Float64[np.ndarray, "3"]


class PoseFilter:
    """Filters the poses of one camera in the order of time; the first after a gap or a jump passes unchanged."""

    def __init__(self, settings: PoseFilterSettings) -> None:
        self._settings = settings
        self._state: _State | None = None

    def __call__(self, pose: BoardPose | None, timestamp_ns: int) -> BoardPose | None:
        """Returns the smoothed pose, with error and alternative of the input pose.

        Args:
            pose: as found; None (no board in sight) is returned and changes nothing.
            timestamp_ns: capture time of the picture.
        """
        if pose is None:
            return None
        measured = np.linalg.inv(pose.world_from_camera)
        self._state = self._next(measured, timestamp_ns)
        return replace(pose, world_from_camera=np.linalg.inv(self._state.smooth))

    def _next(self, measured: Float64[np.ndarray, "4 4"], timestamp_ns: int) -> _State:
        last = self._state
        fresh = _State(timestamp_ns, measured, measured, np.zeros(3), np.zeros(3))
        if last is None:
            return fresh
        period_s = (timestamp_ns - last.timestamp_ns) / 1e9
        if not 0 < period_s <= GAP_S:
            return fresh
        velocity = (measured[:3, 3] - last.measured[:3, 3]) / period_s
        turn_rate = _turn(last.measured, measured) / period_s
        if np.linalg.norm(velocity) > JUMP_M_PER_S or np.linalg.norm(turn_rate) > JUMP_RAD_PER_S:
            return fresh
        factor = _smoothing(SPEED_CUTOFF_HZ, period_s)
        velocity = last.velocity + factor * (velocity - last.velocity)
        turn_rate = last.turn_rate + factor * (turn_rate - last.turn_rate)
        moved, turned = (self._smoothing(speed, period_s) for speed in (velocity, turn_rate))
        step, _ = cv2.Rodrigues(turned * _turn(last.smooth, measured))
        place = last.smooth[:3, 3] + moved * (measured[:3, 3] - last.smooth[:3, 3])
        smooth = rigid_matrix(_orthonormal(last.smooth[:3, :3] @ step), place)
        return _State(timestamp_ns, measured, smooth, velocity, turn_rate)

    def _smoothing(self, speed: Float64[np.ndarray, "3"], period_s: float) -> float:
        settings = self._settings
        return _smoothing(settings.min_cutoff_hz + settings.beta * float(np.linalg.norm(speed)), period_s)


def _smoothing(cutoff_hz: float, period_s: float) -> float:
    """Returns the weight of the new value in an exponential low-pass filter."""
    return 1 / (1 + 1 / (2 * np.pi * cutoff_hz * period_s))


def _turn(first: Float64[np.ndarray, "4 4"], second: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "3"]:
    """Returns the rotation vector from one orientation to another, radians."""
    return np.asarray(cv2.Rodrigues(first[:3, :3].T @ second[:3, :3])[0]).ravel()


def _orthonormal(rotation: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "3 3"]:
    """Returns the nearest rotation: products of thousands of small rotations drift."""
    left, _, right = np.linalg.svd(rotation)
    return np.asarray(left @ right)
