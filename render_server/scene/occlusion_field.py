"""Occlusion fields of rigid objects ([D] 5.2): what an object occludes, seen from points on shells around it.

The paper's shells are spheres; a receiver next to the object lies within all of them. Here they are box grids, each
within the next: the innermost fits the object, so that contact is resolved, the outermost ends where its shadow has
faded out. Rays are traced by embree, only towards what encloses the object.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from jaxtyping import Bool, Float16, Float32, Float64, Int32, Int64

from deltalight.render_server.lights.octahedral import even_directions, harmonics
from deltalight.render_server.scene.bvh import RayCaster

Vectors = Float32[np.ndarray, "m 3"]
FINER = 4  # ratio of the numbers of directions of successive sets
FINEST = 2  # sets beyond the first: from afar, few of all directions hit the object
# Fraction of directions that meet back faces from a point inside the object, or in a closed gap.
INSIDE = 0.75
CHUNK = 400_000  # rays traced at once: some 5 ms, after which another thread may run
AIM = 1.02  # margin of the enclosing radius, so that the silhouette of an object that fills its sphere is hit too
BLEND_CELLS = 2  # over which a shell blends into the next at its border; the object lies further inside

ProgressCallback = Callable[[float], None]
"""Takes the fraction of the work that is done (0..1); may raise to cancel the rest."""

PartKeeper = Callable[[str, Callable[[], np.ndarray]], np.ndarray]
"""Returns the part of this name, computed, or as an earlier computation of the same kept it."""


def compute_part(_name: str, compute: Callable[[], np.ndarray]) -> np.ndarray:
    """Computes a part and keeps nothing (a `PartKeeper`)."""
    return compute()


@dataclass(frozen=True, eq=False)
class DirectionSet:
    """Directions of equal solid angle over the whole sphere."""

    directions: Float32[np.ndarray, "n 3"]

    @property
    def solid_angle(self) -> float:
        """Solid angle of one direction, sr."""
        return 4 * math.pi / len(self.directions)


@cache
def direction_set(count: int) -> DirectionSet:
    """Returns a set of `count` directions."""
    return DirectionSet(even_directions(count).astype(np.float32))


@dataclass(frozen=True, eq=False)
class RayHits:
    """Hits of rays on the object: index of the point, index of the direction, triangle, and whether from behind."""

    point: Int64[np.ndarray, " h"]
    direction: Int64[np.ndarray, " h"]
    triangle: Int32[np.ndarray, " h"]
    behind: Bool[np.ndarray, " h"]


class ObjectRays:
    """Traces rays to the triangles of one object; knows the sphere around them.

    Raises:
        DeltalightError: no package that traces rays is installed.
    """

    def __init__(self, corners: Float32[np.ndarray, "m 3 3"]) -> None:
        vertices = corners.reshape(-1, 3)
        self._caster = RayCaster(vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3))
        edges = corners[:, 1:] - corners[:, :1]
        self._normals = np.cross(edges[:, 0], edges[:, 1])
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        self.centre = (low.astype(np.float64) + high) / 2
        self.half = (high.astype(np.float64) - low) / 2
        self.radius = max(float(np.linalg.norm(vertices - self.centre, axis=1).max()), 1e-9)

    def trace(
        self, points: Vectors, count: int
    ) -> Iterator[tuple[Int64[np.ndarray, " p"], DirectionSet, RayHits]]:
        """Traces rays from all points, in chunks: yields point indices, their direction set, and the hits.

        Points within the enclosing sphere use `count` directions; from farther away the object fills less of the
        sphere, and finer sets hit it about as often. Only directions that may hit it are traced.
        """
        finer = self._finer(points)
        for level in range(FINEST + 1):
            chosen = direction_set(count * FINER**level)
            of_level = np.flatnonzero(finer == level)
            parts = -(-len(of_level) * len(chosen.directions) // CHUNK)
            for part in np.array_split(of_level, parts) if parts else []:
                yield part, chosen, self._trace_aimed(points[part], chosen)

    def inside(self, hits: RayHits, points: int, chosen: DirectionSet) -> Bool[np.ndarray, " points"]:
        """Returns which of a chunk's points lie inside the object."""
        behind = np.bincount(hits.point[hits.behind], minlength=points)
        return np.asarray(behind > INSIDE * len(chosen.directions))

    def _finer(self, points: Vectors) -> Int64[np.ndarray, " m"]:
        """Returns the level of the direction set of each point."""
        fraction = (1 - self._aim_cosine(points)) / 2
        steps = np.ceil(np.log(1 / np.maximum(fraction, 1e-9)) / math.log(FINER) - 1e-9)
        return np.clip(steps, 0, FINEST).astype(np.int64)

    def _aim_cosine(self, points: Vectors) -> Float64[np.ndarray, " m"]:
        """Returns the cosine of the half-angle of the enclosing sphere from each point; -1 from inside."""
        ratio = AIM * self.radius / np.maximum(np.linalg.norm(points - self.centre, axis=1), 1e-12)
        return np.where(ratio < 1, np.sqrt(np.maximum(1 - ratio**2, 0)), -1.0)

    def _trace_aimed(self, points: Vectors, chosen: DirectionSet) -> RayHits:
        to_centre = (self.centre - points).astype(np.float32)
        to_centre /= np.maximum(np.linalg.norm(to_centre, axis=1, keepdims=True), 1e-12)
        cosine = self._aim_cosine(points).astype(np.float32)[:, None]
        point, direction = np.nonzero((cosine < 0) | (to_centre @ chosen.directions.T >= cosine))
        return self._trace(points[point], chosen.directions[direction], point, direction)

    def trace_hemisphere(self, points: Vectors, normals: Vectors, chosen: DirectionSet) -> RayHits:
        """Traces all directions of the set above each point's horizon."""
        point, direction = np.nonzero(normals @ chosen.directions.T > 0)
        return self._trace(points[point], chosen.directions[direction], point, direction)

    def _trace(
        self,
        start: Vectors,
        directions: Vectors,
        point: Int64[np.ndarray, " m"],
        direction: Int64[np.ndarray, " m"],
    ) -> RayHits:
        if not len(start):
            return RayHits(point, direction, np.zeros(0, np.int32), np.zeros(0, bool))
        triangle = self._caster.cast(start, directions).triangle
        met = triangle >= 0
        found = triangle[met]
        behind = np.einsum("hk,hk->h", directions[met], self._normals[found]) > 0
        return RayHits(point[met], direction[met], found, behind)


@dataclass(frozen=True)
class FieldSettings:
    """Settings of a field: `order` SH bands, `resolution` samples per edge of a shell, `reach` in enclosing radii."""

    order: int
    shells: int
    resolution: int
    reach: float
    rays: int
    indirect: bool


@dataclass(frozen=True, eq=False)
class ShellGrid:
    """Nested boxes in the asset's frame: `centre`, and half the edges of each, finest first."""

    centre: Float64[np.ndarray, "3"]
    halves: Float64[np.ndarray, "shells 3"]

    def points(self, shell: int, resolution: int) -> Float32[np.ndarray, "n 3"]:
        """Returns the sample points of a shell, x fastest; the outermost lie on its faces."""
        steps = np.linspace(-1, 1, resolution)
        z, y, x = np.meshgrid(steps, steps, steps, indexing="ij")
        unit = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
        return np.asarray(self.centre + unit * self.halves[shell], np.float32)


def place_shells(rays: ObjectRays, settings: FieldSettings) -> ShellGrid:
    """Places shells from just around the object to `reach` times its radius, in even ratios along each axis."""
    margin = 1 - 2 * BLEND_CELLS / (settings.resolution - 1)
    cell = 2 * rays.radius / (settings.resolution - 1)
    first = np.maximum(rays.half / margin, rays.half + BLEND_CELLS * cell / 2)
    last = np.full(3, settings.reach * rays.radius)
    fraction = np.linspace(0, 1, settings.shells)[:, None]
    return ShellGrid(rays.centre, first ** (1 - fraction) * last**fraction)


@dataclass(frozen=True, eq=False)
class OcclusionField:
    """SH of the object's occlusion (1 where a ray meets it) at the samples of its shells, in the asset's frame.

    `transfer`, if requested: the radiance that the object reflects there (9 coefficients) for light of unit
    coefficients (9) and, where materials are the asset's own, its colours: [.., seen, light, RGB].
    """

    grid: ShellGrid
    radius: float
    occlusion: Float16[np.ndarray, "shells n n n k"]
    transfer: Float16[np.ndarray, "shells h h h 9 9 3"] | None


def compute_occlusion(
    rays: ObjectRays,
    grid: ShellGrid,
    settings: FieldSettings,
    progress: ProgressCallback,
    keep: PartKeeper = compute_part,
) -> Float16[np.ndarray, "shells n n n k"]:
    """Samples the occlusion on all shells, each of which is a part of its own."""
    found = []
    for shell in range(settings.shells):

        def report(fraction: float, shell: int = shell) -> None:
            progress((shell + fraction) / settings.shells)

        compute = partial(_shell_occlusion, rays, grid, shell, settings, report)
        found.append(keep(f"occlusion-{shell}", compute))
    return np.stack(found)


def _shell_occlusion(
    rays: ObjectRays, grid: ShellGrid, shell: int, settings: FieldSettings, report: ProgressCallback
) -> Float16[np.ndarray, "n n n k"]:
    n = settings.resolution
    values, inside = _occlusion_at(rays, grid.points(shell, n), settings, report)
    spacing = 2 * grid.halves[shell][::-1] / (n - 1)
    return fill_inside(values.reshape(n, n, n, -1), inside.reshape(n, n, n), spacing).astype(np.float16)


def _occlusion_at(
    rays: ObjectRays, points: Float32[np.ndarray, "n 3"], settings: FieldSettings, report: ProgressCallback
) -> tuple[Float32[np.ndarray, "n k"], Bool[np.ndarray, " n"]]:
    """Returns the coefficients at points, and which points lie inside the object."""
    values = np.zeros((len(points), settings.order**2), np.float32)
    inside, finished = np.zeros(len(points), bool), 0
    for part, chosen, hits in rays.trace(points, settings.rays):
        basis = (harmonics(chosen.directions, settings.order) * chosen.solid_angle).astype(np.float32)
        met = np.zeros((len(part), len(basis)), np.float32)
        met[hits.point, hits.direction] = 1
        values[part], inside[part] = met @ basis, rays.inside(hits, len(part), chosen)
        finished += len(part)
        report(finished / len(points))
    return values, inside


def fill_inside(
    values: Float32[np.ndarray, "n n n *rest"],
    inside: Bool[np.ndarray, "n n n"],
    spacing: Float64[np.ndarray, "3"],
) -> Float32[np.ndarray, "n n n *rest"]:
    """Gives samples inside the object the nearest value outside: all is occluded inside, half at the surface."""
    if not inside.any() or inside.all():
        return values
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(inside, sampling=spacing, return_distances=False, return_indices=True)
    return np.asarray(values[tuple(nearest)])
