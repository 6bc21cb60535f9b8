"""Rays from a point to an object's triangles, aimed at what encloses them, for precomputation (embree)."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from protocol.errors import DeltalightError
from render_server.scene.spherical_harmonics import even_directions

Vectors = Float32[np.ndarray, "m 3"]
FINER = 4  # times as many directions in the next finer set
FINEST = 2  # sets beyond the first: a ball seen from afar is met by few of all directions
INSIDE = 0.75  # share of all directions that meet the object from behind: a point within it, or within a closed gap
CHUNK = 400_000  # rays tested at once: some 5 ms, between which another thread may run
AIM = 1.02  # times the enclosing radius: the rim of an object that fills its sphere is met too


@dataclass(frozen=True, eq=False)
class DirectionSet:
    """Directions of equal solid angle over the whole sphere."""

    directions: Float32[np.ndarray, "n 3"]

    @property
    def solid_angle(self) -> float:
        """Of one direction, sr."""
        return 4 * math.pi / len(self.directions)


@cache
def direction_set(count: int) -> DirectionSet:
    """Return a set of `count` directions."""
    return DirectionSet(even_directions(count).astype(np.float32))


@dataclass(frozen=True, eq=False)
class RayHits:
    """What met the object: the point's number, the direction's number in its set, triangle, and seen from behind."""

    point: Int64[np.ndarray, " h"]
    direction: Int64[np.ndarray, " h"]
    triangle: Int32[np.ndarray, " h"]
    behind: Bool[np.ndarray, " h"]


class ObjectRays:
    """The triangles of one object, and the sphere around them.

    Raises:
        DeltalightError: the package embreex is not installed.
    """

    def __init__(self, corners: Float32[np.ndarray, "m 3 3"]) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as error:
            raise DeltalightError(
                "Method aroof traces rays with the package embreex, which is not installed: pip install embreex."
            ) from error
        self._scene = EmbreeScene()
        vertices = np.ascontiguousarray(corners.reshape(-1, 3))
        faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
        self._mesh = TriangleMesh(self._scene, vertices, faces)
        edges = corners[:, 1:] - corners[:, :1]
        self._normals = np.cross(edges[:, 0], edges[:, 1])
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        self.centre = (low.astype(np.float64) + high) / 2
        self.half = (high.astype(np.float64) - low) / 2
        self.radius = max(float(np.linalg.norm(vertices - self.centre, axis=1).max()), 1e-9)

    def aimed(
        self, points: Vectors, count: int
    ) -> Iterator[tuple[Int64[np.ndarray, " p"], DirectionSet, RayHits]]:
        """Trace rays from all points, some points at a time: their numbers, the directions they took, what was met.

        Points within the enclosing sphere take `count` directions; from farther away the object fills less of the
        sphere, and finer sets meet it about as often. Only directions that may meet it are traced.
        """
        finer = self._finer(points)
        for level in range(FINEST + 1):
            chosen = direction_set(count * FINER**level)
            of_level = np.flatnonzero(finer == level)
            parts = -(-len(of_level) * len(chosen.directions) // CHUNK)
            for part in np.array_split(of_level, parts) if parts else []:
                yield part, chosen, self._meet(points[part], chosen)

    def inside(self, hits: RayHits, points: int, chosen: DirectionSet) -> Bool[np.ndarray, " points"]:
        """Return which of the points that `aimed` gave lie within the object."""
        behind = np.bincount(hits.point[hits.behind], minlength=points)
        return np.asarray(behind > INSIDE * len(chosen.directions))

    def _finer(self, points: Vectors) -> Int64[np.ndarray, " m"]:
        """Which set each point takes."""
        share = (1 - self._aim_cosine(points)) / 2
        steps = np.ceil(np.log(1 / np.maximum(share, 1e-9)) / math.log(FINER) - 1e-9)
        return np.clip(steps, 0, FINEST).astype(np.int64)

    def _aim_cosine(self, points: Vectors) -> Float64[np.ndarray, " m"]:
        """Cosine of the half-angle under which a point sees the enclosing sphere; -1 from inside."""
        ratio = AIM * self.radius / np.maximum(np.linalg.norm(points - self.centre, axis=1), 1e-12)
        return np.where(ratio < 1, np.sqrt(np.maximum(1 - ratio**2, 0)), -1.0)

    def _meet(self, points: Vectors, chosen: DirectionSet) -> RayHits:
        way = (self.centre - points).astype(np.float32)
        way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
        cosine = self._aim_cosine(points).astype(np.float32)[:, None]
        point, direction = np.nonzero((cosine < 0) | (way @ chosen.directions.T >= cosine))
        return self._met(points[point], chosen.directions[direction], point, direction)

    def meet_along(self, points: Vectors, normals: Vectors, chosen: DirectionSet) -> RayHits:
        """Trace every direction of the set above each point's horizon."""
        point, direction = np.nonzero(normals @ chosen.directions.T > 0)
        return self._met(points[point], chosen.directions[direction], point, direction)

    def _met(
        self, start: Vectors, way: Vectors, point: Int64[np.ndarray, " m"], direction: Int64[np.ndarray, " m"]
    ) -> RayHits:
        if not len(start):
            return RayHits(point, direction, np.zeros(0, np.int32), np.zeros(0, bool))
        triangle = self._scene.run(np.ascontiguousarray(start), np.ascontiguousarray(way), query="INTERSECT")
        met = triangle >= 0
        found = triangle[met]
        behind = np.einsum("hk,hk->h", way[met], self._normals[found]) > 0
        return RayHits(point[met], direction[met], found, behind)
