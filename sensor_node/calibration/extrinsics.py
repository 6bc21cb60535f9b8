"""Pose of the fish-eye camera: from pictures in which it, or it and the colour camera, see the marker board."""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.dataset_lists import MAX_PAIRING_NS
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.fisheye_lens import FisheyeLens
from deltalight.protocol.frames import FisheyePictures, SensorFrame
from deltalight.sensor_node.calibration.poses import mean_pose, pose_offsets, target_pose
from deltalight.sensor_node.calibration.targets import MarkerBoard
from deltalight.sensor_node.calibration.views import LEAST_POINTS
from deltalight.sensor_node.markers import BoardDetector

Pose = Float64[np.ndarray, "4 4"]
# A mean of fewer poses says nothing about its spread.
LEAST_POSES = 5
# One degree moves a lamp two metres away by 3.5 cm, and a highlight by twice the angle.
MOST_SPREAD_M, MOST_SPREAD_DEG = 0.01, 1.0
# A pose that differs by more than three times the median and this is a mistake.
OUTLIER_MEDIANS, OUTLIER_M, OUTLIER_DEG = 3.0, 0.002, 0.2


class Placement(NamedTuple):
    """A mean transform with the rms offsets of the averaged poses."""

    transform: Pose
    poses: int
    outliers: int
    spread_m: float
    spread_deg: float


def fisheye_in_world(pictures: FisheyePictures, board: MarkerBoard) -> Pose | None:
    """Returns world_from_fisheye by the board in a fish-eye picture (of a bracket: the first one that shows it)."""
    for picture in pictures.pictures:
        if picture.dtype == np.uint8:
            pose = _board_pose(picture, pictures.calibration.lens, board)
            if pose is not None:
                return np.asarray(np.linalg.inv(pose))
    return None


def _board_pose(color: UInt8[np.ndarray, "h w 3"], lens: FisheyeLens, board: MarkerBoard) -> Pose | None:
    gray = cv2.cvtColor(np.ascontiguousarray(color), cv2.COLOR_RGB2GRAY)
    sighting = board.find(gray)
    if sighting is None or len(sighting.numbers) < LEAST_POINTS:
        return None
    if isinstance(lens, EquidistantLens):
        sighting = board.refined(gray, sighting, lens.camera)
    directions = lens.directions(sighting.pixels)
    known = np.isfinite(directions).all(axis=1)
    if np.count_nonzero(known) < LEAST_POINTS:
        return None
    return target_pose(board.points[sighting.numbers][known], directions[known])


def world_from_fisheye_poses(frames: Iterable[SensorFrame], board: BoardSpec) -> Iterator[Pose]:
    """Yields the pose of a fixed fish-eye camera from each of its pictures that shows the board."""
    target, last = MarkerBoard(board), None
    for frame in frames:
        if frame.fisheye is not None and frame.fisheye is not last:
            last = frame.fisheye
            pose = fisheye_in_world(last, target)
            if pose is not None:
                yield pose


def rgb_from_fisheye_poses(frames: Iterable[SensorFrame], board: BoardSpec) -> Iterator[Pose]:
    """Yields the transform from each moment (within 20 ms) at which both cameras see the board."""
    target, detector = MarkerBoard(board), None
    for frame in frames:
        if frame.fisheye is None or abs(frame.timestamp_ns - frame.fisheye.timestamp_ns) > MAX_PAIRING_NS:
            continue
        detector = detector or BoardDetector(board, frame.camera, frame.response)
        seen = detector.detect(frame.color)
        world_from_fisheye = None if seen is None else fisheye_in_world(frame.fisheye, target)
        if seen is not None and world_from_fisheye is not None:
            yield np.linalg.inv(seen.world_from_camera) @ world_from_fisheye


def mean_placement(poses: Sequence[Pose], name: str) -> Placement:
    """Returns the mean of poses without outliers; `name` names the transform in sentences.

    Raises:
        DeltalightError: there are too few poses, or they differ too much.
    """
    if len(poses) < LEAST_POSES:
        raise DeltalightError(
            f"the board gives {name} at only {len(poses)} moments, and {LEAST_POSES} are needed; record it at rest"
            " in more places, where every camera involved sees all of it at the same time."
        )
    mean = mean_pose(poses)
    metres, degrees = pose_offsets(poses, mean)
    kept = (metres <= max(OUTLIER_M, OUTLIER_MEDIANS * float(np.median(metres)))) & (
        degrees <= max(OUTLIER_DEG, OUTLIER_MEDIANS * float(np.median(degrees)))
    )
    good = [pose for pose, keep in zip(poses, kept, strict=True) if keep]
    mean = mean_pose(good)
    metres, degrees = pose_offsets(good, mean)
    spread_m, spread_deg = (float(np.sqrt(np.mean(values**2))) for values in (metres, degrees))
    if len(good) < LEAST_POSES or spread_m > MOST_SPREAD_M or spread_deg > MOST_SPREAD_DEG:
        raise DeltalightError(
            f"the poses for {name} spread by {1e3 * spread_m:.1f} mm and {spread_deg:.2f} degrees (at most "
            f"{1e3 * MOST_SPREAD_M:.0f} mm and {MOST_SPREAD_DEG:.0f} degree is acceptable); calibrate the lenses"
            " first, and record the board larger in the picture and at rest."
        )
    return Placement(mean, len(good), len(poses) - len(good), spread_m, spread_deg)
