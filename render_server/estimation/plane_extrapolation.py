"""Detects the large planes in view, and extrapolates those that the picture's border cuts: walls, table and floor.

How far is unknown. A plane seen over a length L continues for at least d beyond the border with probability
L / (L + d), because the border cuts it at a place that is independent of it (Gott 1993, Nature 363, for lengths in
place of times). L is the longest extent that is known of the room, because its planes meet: that of a plane in view
with the lamps, which the room contains. A wall of which the picture shows a strip is unlikely to end just above it or
beside it. Its radiance there follows from the lights and from its reflectance where it is seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from deltalight.protocol.octahedral import octahedral_grid
from deltalight.render_server.lights.light_models import Lamp, Light, incident_light

# Four times the planes of a room's corner: faces of things may be larger than what the border leaves of a wall.
MAX_PLANES = 12
# A strip as wide as 1/400 of the picture; a smaller fraction of the samples, or fewer points, is chance.
MIN_FRACTION = 0.0025
MIN_POINTS = 12
CANDIDATES = 200
# Nearer to this plane than to one at a right angle: correlated noise of stereo turns normals by more than 15 degrees.
NORMAL_COSINE = float(np.sqrt(0.5))
PLANES_AT_ONCE = 16  # of hypotheses: their distances to all points stay in the processor's cache
REFINEMENTS = 3  # least-squares fits to the inliers; after that a plane hardly moves


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

    def count_inliers(
        self, axes: Float64[np.ndarray, "m 3"], offsets: Float64[np.ndarray, " m"]
    ) -> Int64[np.ndarray, " m"]:
        """Returns how many points are inliers of each of several planes."""
        position, normal = (np.ascontiguousarray(each.T) for each in (self.position, self.normal))
        count = np.zeros(len(axes), np.int64)
        for first in range(0, len(axes), PLANES_AT_ONCE):
            some = slice(first, first + PLANES_AT_ONCE)
            away = axes[some] @ position
            away -= offsets[some, None]
            lies = np.abs(away, out=away) <= self.tolerance_m
            lies &= np.matmul(axes[some], normal, out=away) >= NORMAL_COSINE
            count[some] = [np.count_nonzero(each) for each in lies]
        return count

    def only(self, chosen: Int64[np.ndarray, " n"]) -> "PointCloud":
        """Returns the chosen points."""
        return PointCloud(self.position[chosen], self.normal[chosen], self.tolerance_m[chosen])


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
    axes, places = cloud.normal[candidates], cloud.position[candidates]
    count = cloud.only(remaining).count_inliers(axes, np.einsum("mi,mi->m", axes, places))
    best = int(np.argmax(count))
    axis, offset = axes[best], float(places[best] @ axes[best])
    for _ in range(REFINEMENTS):
        inliers = free & cloud.inliers(axis, offset)
        if np.count_nonzero(inliers) < min_count:
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


MAX_SLANT_ERROR = 0.05  # rad: moves a wall by a twentieth of how far it goes on
# Fraction of the samples that noise may put behind a wall.
MAX_STRAY_FRACTION = 0.005
MIN_IRRADIANCE = 1e-6


@dataclass(frozen=True, eq=False)
class ViewFrustum:
    """The camera's view: rays (x/z, y/z) between `low` and `high`."""

    camera_from_world: Float64[np.ndarray, "4 4"]
    low: Float64[np.ndarray, "2"]
    high: Float64[np.ndarray, "2"]

    def inside(self, places: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "m 4"]:
        """Returns signed, unnormalised distances of positions (world) to the four sides, positive inside."""
        seen = places @ self.camera_from_world[:3, :3].T + self.camera_from_world[:3, 3]
        x_y, z = seen[:, :2], seen[:, 2:]
        return np.concatenate([x_y - self.low * z, self.high * z - x_y], axis=1)


@dataclass(frozen=True, eq=False)
class RealSamples:
    """Samples of real surfaces in view: position (world, m), linear radiance, and irradiance.

    `lit` is the fraction of the lights' unshadowed light that arrives, `indirect` the irradiance from all else. A
    sample may lie `tolerance_m` off its plane.
    """

    position: Float64[np.ndarray, "k 3"]
    radiance: Float64[np.ndarray, "k 3"]
    lit: Float64[np.ndarray, " k"]
    indirect: Float64[np.ndarray, "k 3"]
    tolerance_m: Float64[np.ndarray, " k"]

    def only(self, chosen: Bool[np.ndarray, " k"]) -> "RealSamples":
        """Returns the chosen samples."""
        fields = (self.position, self.radiance, self.lit, self.indirect, self.tolerance_m)
        return RealSamples(*(values[chosen] for values in fields))


@dataclass(frozen=True, eq=False)
class ExtrapolatedPlanes:
    """Octahedral maps (world axes): radiance of the extrapolated planes, and the probability that they exist."""

    radiance: Float32[np.ndarray, "n n 3"]
    probability: Float32[np.ndarray, "n n 1"]


@dataclass(frozen=True, eq=False)
class _PlaneLayer:
    """One plane in every direction: distance (m, infinite where rays miss it), probability, radiance."""

    distance: Float64[np.ndarray, " n"]
    probability: Float64[np.ndarray, " n"]
    radiance: Float64[np.ndarray, "n 3"]


def extrapolate_planes(
    planes: Sequence[DetectedPlane],
    samples: RealSamples,
    lights: Sequence[Light],
    frustum: ViewFrustum,
    *,
    centre: Float64[np.ndarray, "3"],
    size: int,
) -> ExtrapolatedPlanes:
    """Extrapolates planes that the picture's border cuts, as seen from `centre` (world, m).

    `size` is the edge of the maps in texels. Nearer planes occlude farther ones.
    """
    directions = octahedral_grid(size).reshape(-1, 3)
    bounds = [
        (plane, samples.only(plane.inliers))
        for plane in planes
        if _bounds_room(plane, samples) and _has_certain_slant(samples.position[plane.inliers])
    ]
    lamps = _lamps_inside([plane for plane, _ in bounds], lights)
    known_m = max((_longest_extent(np.vstack([seen.position, lamps])) for _, seen in bounds), default=0.0)
    layers = [
        _plane_layer(plane, seen, lights, frustum, known_m=known_m, centre=centre, directions=directions)
        for plane, seen in bounds
    ]
    radiance, beyond = np.zeros((len(directions), 3)), np.ones(len(directions))
    for nth in _nearest_first(layers):
        probability = beyond * nth.probability
        radiance += probability[:, None] * nth.radiance
        beyond -= probability
    met = 1 - beyond
    mean = radiance / np.maximum(met, np.finfo(np.float32).tiny)[:, None]
    return ExtrapolatedPlanes(
        mean.reshape(size, size, 3).astype(np.float32), met.reshape(size, size, 1).astype(np.float32)
    )


def _nearest_first(layers: Sequence[_PlaneLayer]) -> list[_PlaneLayer]:
    """Sorts layers by distance in each direction: the first result is the nearest one everywhere."""
    if not layers:
        return []
    distance, probability, radiance = (
        np.stack([getattr(layer, name) for layer in layers])
        for name in ("distance", "probability", "radiance")
    )
    order = np.argsort(distance, axis=0)
    every = np.arange(distance.shape[1])
    return [
        _PlaneLayer(distance[rank, every], probability[rank, every], radiance[rank, every]) for rank in order
    ]


def _bounds_room(plane: DetectedPlane, samples: RealSamples) -> bool:
    """Whether nothing is visible behind a plane; faces of things have the room behind them, and end."""
    behind = samples.position @ plane.normal < plane.offset - 3 * samples.tolerance_m
    return bool(behind.mean() <= MAX_STRAY_FRACTION)


def _has_certain_slant(position: Float64[np.ndarray, "k 3"]) -> bool:
    """Whether the standard error of the normal of the plane through some points is small: a strip may be short."""
    away_m, across_m, _ = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(position.T)), 0))
    return bool(away_m <= MAX_SLANT_ERROR * across_m * np.sqrt(len(position)))


def _lamps_inside(bounds: Sequence[DetectedPlane], lights: Sequence[Light]) -> Float64[np.ndarray, "n 3"]:
    """Returns the positions of lamps that no plane of the room has behind it: those light the room from outside."""
    inside = [
        light.position
        for light in lights
        if isinstance(light, Lamp) and all(light.position @ plane.normal > plane.offset for plane in bounds)
    ]
    return np.array(inside, np.float64).reshape(-1, 3)


def _plane_layer(
    plane: DetectedPlane,
    seen: RealSamples,
    lights: Sequence[Light],
    frustum: ViewFrustum,
    *,
    known_m: float,
    centre: Float64[np.ndarray, "3"],
    directions: Float64[np.ndarray, "n 3"],
) -> _PlaneLayer:
    falling = directions @ plane.normal
    height = plane.normal @ centre - plane.offset
    meets = (falling < 0) & (height > 0)
    distance = np.full(len(directions), np.inf)
    distance[meets] = -height / falling[meets]
    probability, radiance = np.zeros(len(directions)), np.zeros((len(directions), 3))
    places = centre + distance[meets, None] * directions[meets]
    probability[meets] = _continuation_probability(places, seen, frustum, known_m)
    radiance[meets] = _expected_radiance(places, plane, seen, lights)
    return _PlaneLayer(distance, probability, radiance)


def _continuation_probability(
    places: Float64[np.ndarray, "m 3"], seen: RealSamples, frustum: ViewFrustum, known_m: float
) -> Float64[np.ndarray, " m"]:
    """Returns the probability that a plane extends to positions on it.

    The visible length is twice that from the centre of the visible part to where the line to the position leaves the
    view, or the longest extent `known_m` (m) that is known of the room if that is longer.
    """
    middle = seen.position.mean(axis=0)
    start = frustum.inside(middle[None])
    end = frustum.inside(places)
    in_view = np.divide(start, start - end, out=np.ones_like(end), where=end < 0).min(axis=1)
    away_m = np.linalg.norm(places - middle, axis=1)
    length_m = np.maximum(2 * in_view * away_m, known_m)
    return np.asarray(length_m / (length_m + (1 - in_view) * away_m))


def _longest_extent(positions: Float64[np.ndarray, "k 3"]) -> float:
    """Returns the extent (m) of positions along the direction in which they scatter most."""
    away = positions - positions.mean(axis=0)
    _, axes = np.linalg.eigh(away.T @ away)
    return float(np.ptp(away @ axes[:, -1]))


def _expected_radiance(
    places: Float64[np.ndarray, "m 3"], plane: DetectedPlane, seen: RealSamples, lights: Sequence[Light]
) -> Float64[np.ndarray, "m 3"]:
    """Returns the radiance at positions on a plane: its visible albedo under the expected irradiance.

    Radiance that an albedo of 1 does not explain comes from unknown lights, and is assumed equal beyond the border.
    """
    direct = _irradiance(lights, seen.position, plane.normal) * seen.lit[:, None]
    irradiance = direct + seen.indirect
    ratio = np.median(seen.radiance / np.maximum(irradiance, MIN_IRRADIANCE), axis=0)
    reflected = np.minimum(ratio, 1 / np.pi)
    unexplained = np.median(seen.radiance - reflected * irradiance, axis=0)
    expected = seen.lit.mean() * _irradiance(lights, places, plane.normal) + seen.indirect.mean(axis=0)
    return np.asarray(np.maximum(reflected * expected + unexplained, 0))


def _irradiance(
    lights: Sequence[Light], places: Float64[np.ndarray, "m 3"], normal: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "m 3"]:
    """Returns the unshadowed irradiance of all lights at positions with this normal."""
    total = np.zeros(places.shape)
    for light in lights:
        seen = incident_light(light, places)
        total += seen.irradiance * np.maximum(seen.to_light @ normal, 0)[:, None]
    return total
