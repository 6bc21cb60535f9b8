"""The large planes of the real scene that a picture shows: table, walls, floor."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

# Twice as many planes as a corner of a room has: things have large faces too.
MOST_PLANES = 6
# A smaller share of the samples is a thing, or chance.
LEAST_SHARE = 0.02
CANDIDATES = 200
# Nearer to this plane than to one at a right angle: correlated noise of stereo turns normals by more than 15 degrees.
NORMAL_COSINE = float(np.sqrt(0.5))
LEAST_POINTS = 3
ROUNDS = 3  # of fitting to what lies on the plane; after that it hardly moves


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points with unit normals (towards the camera) and how far off its surface each may lie, metres."""

    position: Float64[np.ndarray, "k 3"]
    normal: Float64[np.ndarray, "k 3"]
    tolerance_m: Float64[np.ndarray, " k"]

    def on_plane(self, axis: Float64[np.ndarray, "3"], offset: float) -> Bool[np.ndarray, " k"]:
        """Return which points lie on, and along, the plane with this normal and this distance from the origin."""
        near = np.abs(self.position @ axis - offset) <= self.tolerance_m
        return np.asarray(near & (self.normal @ axis >= NORMAL_COSINE))


@dataclass(frozen=True, eq=False)
class SeenPlane:
    """Points with `normal` (unit, towards the camera) . point = `offset`, m; `on_it`: which samples lie there."""

    normal: Float64[np.ndarray, "3"]
    offset: float
    on_it: Bool[np.ndarray, " k"]


def find_planes(cloud: PointCloud) -> list[SeenPlane]:
    """Return the planes that most points lie on, the largest first; no point is on two of them.

    Sequential RANSAC (Fischler & Bolles 1981) whose hypotheses are single points with their normals, evenly spread
    instead of drawn, so that the same frame gives the same planes.
    """
    free = np.ones(len(cloud.position), bool)
    found: list[SeenPlane] = []
    while len(found) < MOST_PLANES:
        plane = _largest(cloud, free)
        if plane is None:
            break
        found.append(plane)
        free &= ~plane.on_it
    return found


def _largest(cloud: PointCloud, free: Bool[np.ndarray, " k"]) -> SeenPlane | None:
    """The plane with most of the free points, if they are enough."""
    left = np.flatnonzero(free)
    least = max(LEAST_SHARE * len(free), LEAST_POINTS)
    if len(left) < least:
        return None
    tried = left[np.linspace(0, len(left) - 1, min(CANDIDATES, len(left))).astype(int)]
    planes = [(cloud.normal[i], float(cloud.position[i] @ cloud.normal[i])) for i in tried]
    count = [int((free & cloud.on_plane(*plane)).sum()) for plane in planes]
    axis, offset = planes[int(np.argmax(count))]
    for _ in range(ROUNDS):
        on_it = free & cloud.on_plane(axis, offset)
        if on_it.sum() < least:
            return None
        axis, offset = _fitted(cloud.position[on_it], axis)
    return SeenPlane(axis, offset, on_it)


def _fitted(
    position: Float64[np.ndarray, "k 3"], towards: Float64[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, "3"], float]:
    """Normal (to the side of `towards`) and offset of the plane through points, by least squares."""
    middle = position.mean(axis=0)
    _, axes = np.linalg.eigh((position - middle).T @ (position - middle))
    axis = axes[:, 0] * np.sign(axes[:, 0] @ towards)
    return axis, float(middle @ axis)
