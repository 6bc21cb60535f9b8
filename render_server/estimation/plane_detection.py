"""Detects the large planes of the real scene in view: table, walls, floor."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

# Twice the planes of a room's corner, because things have large faces too.
MAX_PLANES = 6
# A smaller fraction of the samples is a thing, or coincidence.
MIN_FRACTION = 0.02
CANDIDATES = 200
# Closer to this plane than to one at a right angle: correlated noise of stereo tilts normals by more than 15 degrees.
NORMAL_COSINE = float(np.sqrt(0.5))
MIN_POINTS = 3
REFINEMENTS = 3  # least-squares fits to the inliers; a plane hardly moves afterwards


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points with unit normals (towards the camera) and the tolerance of their distance to a surface, metres."""

    position: Float64[np.ndarray, "k 3"]
    normal: Float64[np.ndarray, "k 3"]
    tolerance_m: Float64[np.ndarray, " k"]

    def inliers(self, axis: Float64[np.ndarray, "3"], offset: float) -> Bool[np.ndarray, " k"]:
        """Returns which points lie on the plane with this normal and distance from the origin, and face its way."""
        near = np.abs(self.position @ axis - offset) <= self.tolerance_m
        return np.asarray(near & (self.normal @ axis >= NORMAL_COSINE))


@dataclass(frozen=True, eq=False)
class DetectedPlane:
    """The plane normal . point = offset (m; unit normal towards the camera), and which samples lie on it."""

    normal: Float64[np.ndarray, "3"]
    offset: float
    inliers: Bool[np.ndarray, " k"]


def detect_planes(cloud: PointCloud) -> list[DetectedPlane]:
    """Returns the planes with the most points, largest first; no point belongs to two of them.

    Sequential RANSAC (Fischler & Bolles 1981) whose hypotheses are single points with their normals, evenly spread
    instead of drawn at random, so that the same frame gives the same planes.
    """
    free = np.ones(len(cloud.position), bool)
    found: list[DetectedPlane] = []
    while len(found) < MAX_PLANES:
        plane = _largest_plane(cloud, free)
        if plane is None:
            break
        found.append(plane)
        free &= ~plane.inliers
    return found


def _largest_plane(cloud: PointCloud, free: Bool[np.ndarray, " k"]) -> DetectedPlane | None:
    """Returns the plane with the most free points; None if there are too few."""
    remaining = np.flatnonzero(free)
    min_count = max(MIN_FRACTION * len(free), MIN_POINTS)
    if len(remaining) < min_count:
        return None
    candidates = remaining[np.linspace(0, len(remaining) - 1, min(CANDIDATES, len(remaining))).astype(int)]
    planes = [(cloud.normal[i], float(cloud.position[i] @ cloud.normal[i])) for i in candidates]
    count = [int((free & cloud.inliers(*plane)).sum()) for plane in planes]
    axis, offset = planes[int(np.argmax(count))]
    for _ in range(REFINEMENTS):
        inliers = free & cloud.inliers(axis, offset)
        if inliers.sum() < min_count:
            return None
        axis, offset = _fit_plane(cloud.position[inliers], axis)
    return DetectedPlane(axis, offset, inliers)


def _fit_plane(
    position: Float64[np.ndarray, "k 3"], facing: Float64[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, "3"], float]:
    """Fits a plane to points by least squares; its normal faces to the side of `facing`."""
    middle = position.mean(axis=0)
    _, axes = np.linalg.eigh((position - middle).T @ (position - middle))
    axis = axes[:, 0] * np.sign(axes[:, 0] @ facing)
    return axis, float(middle @ axis)
