"""The large planes of the real scene that a picture shows: table, walls, floor."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

# Twice as many planes as a corner of a room has: things have large faces too.
MAX_PLANES = 6
# A smaller share of the samples is a thing, or chance.
MIN_FRACTION = 0.02
CANDIDATES = 200
# Nearer to this plane than to one at a right angle: correlated noise of stereo turns normals by more than 15 degrees.
NORMAL_COSINE = float(np.sqrt(0.5))
MIN_POINTS = 3
REFINEMENTS = 3  # of fitting to what lies on the plane; after that it hardly moves


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points with unit normals (towards the camera) and how far off its surface each may lie, metres."""

    position: Float64[np.ndarray, "k 3"]
    normal: Float64[np.ndarray, "k 3"]
    tolerance_m: Float64[np.ndarray, " k"]

    def inliers(self, axis: Float64[np.ndarray, "3"], offset: float) -> Bool[np.ndarray, " k"]:
        """Return which points lie on, and along, the plane with this normal and this distance from the origin."""
        near = np.abs(self.position @ axis - offset) <= self.tolerance_m
        return np.asarray(near & (self.normal @ axis >= NORMAL_COSINE))


@dataclass(frozen=True, eq=False)
class DetectedPlane:
    """Points with `normal` (unit, towards the camera) . point = `offset`, m; `on_it`: which samples lie there."""

    normal: Float64[np.ndarray, "3"]
    offset: float
    inliers: Bool[np.ndarray, " k"]


def detect_planes(cloud: PointCloud) -> list[DetectedPlane]:
    """Return the planes that most points lie on, the largest first; no point is on two of them.

    Sequential RANSAC (Fischler & Bolles 1981) whose hypotheses are single points with their normals, evenly spread
    instead of drawn, so that the same frame gives the same planes.
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
    """The plane with most of the free points, if they are enough."""
    left = np.flatnonzero(free)
    least = max(MIN_FRACTION * len(free), MIN_POINTS)
    if len(left) < least:
        return None
    tried = left[np.linspace(0, len(left) - 1, min(CANDIDATES, len(left))).astype(int)]
    planes = [(cloud.normal[i], float(cloud.position[i] @ cloud.normal[i])) for i in tried]
    count = [int((free & cloud.inliers(*plane)).sum()) for plane in planes]
    axis, offset = planes[int(np.argmax(count))]
    for _ in range(REFINEMENTS):
        inliers = free & cloud.inliers(axis, offset)
        if inliers.sum() < least:
            return None
        axis, offset = _fit_plane(cloud.position[inliers], axis)
    return DetectedPlane(axis, offset, inliers)


def _fit_plane(
    position: Float64[np.ndarray, "k 3"], side: Float64[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, "3"], float]:
    """Normal (to the side of `towards`) and offset of the plane through points, by least squares."""
    middle = position.mean(axis=0)
    _, axes = np.linalg.eigh((position - middle).T @ (position - middle))
    axis = axes[:, 0] * np.sign(axes[:, 0] @ side)
    return axis, float(middle @ axis)
