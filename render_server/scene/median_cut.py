"""Splitting an environment map into a few distant lights and a smooth residual (METHOD 2)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from render_server.scene.environment import (
    LUMINANCE,
    WORK_SIZE,
    EnvironmentMap,
    map_directions,
    pixel_solid_angles,
)

PEAK_THRESHOLD = 4.0
LEAST_SHARE = 0.01
# Lights of this angular radius are not cut again: sampling a light's disc does the rest.
LEAST_RADIUS_RAD = float(np.radians(5.0))


@dataclass(frozen=True)
class Region:
    """A rectangle of a latitude-longitude map: rows and columns from..to (exclusive)."""

    top: int
    bottom: int
    left: int
    right: int


@dataclass(frozen=True, eq=False)
class RegionLight:
    """What a region sends: `toward` is the unit direction to it (world), `irradiance` across the beam."""

    toward: Float64[np.ndarray, "3"]
    irradiance: Float64[np.ndarray, "3"]
    angular_radius_rad: float


@dataclass(frozen=True, eq=False)
class Split:
    """Lights and the rest of a map; together they are the map."""

    lights: tuple[RegionLight, ...]
    residual: EnvironmentMap


def split_environment(
    environment: EnvironmentMap,
    count: int = 4,
    *,
    threshold: float = PEAK_THRESHOLD,
    whole_map: bool = False,
) -> Split:
    """Split a map into at most `count` lights and a residual (METHOD 2).

    R = L min(1, c / lum L) with c = `threshold` times the solid-angle mean luminance; P = L - R is cut into
    regions, each of which becomes a light. Regions under 1 % of the map's energy go back to R. With
    `whole_map` everything is cut and nothing is left (the papers' way).
    """
    small = environment.resized(*WORK_SIZE)
    radiance = small.radiance
    rows, columns = radiance.shape[:2]
    luminance = radiance @ LUMINANCE
    solid_angle = pixel_solid_angles(rows, columns)
    energy = float((luminance * solid_angle).sum(dtype=np.float64))
    limit = 0.0 if whole_map else threshold * energy / (4 * np.pi)
    residual = radiance * np.minimum(1, limit / np.maximum(luminance, 1e-30))[..., None].astype(np.float32)
    peaks = radiance - residual
    kept, lights = [], []
    seam = _darkest_column((peaks @ LUMINANCE * solid_angle).sum(axis=0))
    cut = np.roll(peaks, -seam, axis=1) * solid_angle[..., None]
    directions = np.roll(map_directions(rows, columns), -seam, axis=1)
    for region in variance_cut(cut @ LUMINANCE, directions, count):
        light = _region_light(region, cut, directions)
        if whole_map or light.irradiance @ LUMINANCE >= LEAST_SHARE * energy:
            kept.append(region)
            lights.append(_turned(light, environment.world_from_map))
    returned = _outside(peaks, kept, seam)
    return Split(tuple(lights), EnvironmentMap(residual + returned, environment.world_from_map))


def _darkest_column(columns: Float32[np.ndarray, " w"]) -> int:
    """Where to open the map so that the seam is least likely to cut a light in two."""
    width = max(1, len(columns) // 64)
    around = np.convolve(np.concatenate([columns, columns[: width - 1]]), np.ones(width), "valid")
    return (int(np.argmin(around)) + width // 2) % len(columns)


def _outside(
    peaks: Float32[np.ndarray, "h w 3"], kept: list[Region], seam: int
) -> Float32[np.ndarray, "h w 3"]:
    """Return the peaks without those in the kept regions (whose columns count from the seam)."""
    rest = np.roll(peaks, -seam, axis=1)
    for region in kept:
        rest[region.top : region.bottom, region.left : region.right] = 0
    return np.roll(rest, seam, axis=1)


def variance_cut(
    weight: Float32[np.ndarray, "h w"], directions: Float32[np.ndarray, "h w 3"], count: int
) -> list[Region]:
    """Variance-minimised median cut (Viriyothai & Debevec 2009) of a weighted set of directions.

    Again and again the region with the greatest weighted squared distance to its centroid is cut, across
    rows or columns, where the two sides' squared distances add up to least. Regions without weight are
    left out, and cutting stops early once every region's angular radius is at most 5 degrees.
    """
    moments = np.concatenate([weight[..., None], weight[..., None] * directions], axis=-1)
    table = np.zeros((weight.shape[0] + 1, weight.shape[1] + 1, 4))
    table[1:, 1:] = moments.astype(np.float64).cumsum(axis=0).cumsum(axis=1)
    if table[-1, -1, 0] <= 0:
        return []
    regions = [Region(0, weight.shape[0], 0, weight.shape[1])]
    while len(regions) < count:
        sums = np.array([_moments(table, region) for region in regions])
        spreads = _spread(sums)
        # Radius as of a light: sqrt(2 mean squared angle).
        spreads[2 * spreads <= LEAST_RADIUS_RAD**2 * sums[:, 0]] = 0
        widest = int(np.argmax(spreads))
        halves = _cut(table, regions[widest])
        if spreads[widest] <= 0 or halves is None:
            break
        regions[widest : widest + 1] = halves
    return [region for region in regions if _moments(table, region)[0] > 0]


def _moments(table: Float64[np.ndarray, "a b 4"], region: Region) -> Float64[np.ndarray, "4"]:
    lower, upper = table[region.bottom], table[region.top]
    return np.asarray(lower[region.right] - lower[region.left] - upper[region.right] + upper[region.left])


def _spread(moments: Float64[np.ndarray, "*n 4"]) -> Float64[np.ndarray, "*n"]:
    """Weighted sum of squared distances of unit vectors to their centroid: W - |sum w d|^2 / W."""
    weight = moments[..., 0]
    pull = (moments[..., 1:] ** 2).sum(axis=-1)
    return np.asarray(np.maximum(weight - pull / np.maximum(weight, 1e-300), 0))


def _cut(table: Float64[np.ndarray, "a b 4"], region: Region) -> tuple[Region, Region] | None:
    """Cut a region where the spreads of both sides add up to least; None if it is a single pixel."""
    top, bottom, left, right = region.top, region.bottom, region.left, region.right
    whole = _moments(table, region)
    band = table[top + 1 : bottom, right] - table[top + 1 : bottom, left]
    above = band - (table[top, right] - table[top, left])
    band = table[bottom, left + 1 : right] - table[top, left + 1 : right]
    before = band - (table[bottom, left] - table[top, left])
    costs = [_spread(side) + _spread(whole - side) for side in (above, before)]
    best = [float(cost.min()) if len(cost) else np.inf for cost in costs]
    if min(best) == np.inf:
        return None
    if best[0] <= best[1]:
        row = top + 1 + int(np.argmin(costs[0]))
        return Region(top, row, left, right), Region(row, bottom, left, right)
    column = left + 1 + int(np.argmin(costs[1]))
    return Region(top, bottom, left, column), Region(top, bottom, column, right)


def _region_light(
    region: Region, cut: Float32[np.ndarray, "h w 3"], directions: Float32[np.ndarray, "h w 3"]
) -> RegionLight:
    """Sum a region up: E = sum P dw, centroid, radius = sqrt(2 mean squared angle) (a disc's own radius)."""
    window = np.s_[region.top : region.bottom, region.left : region.right]
    radiance = cut[window].reshape(-1, 3).astype(np.float64)
    weight = radiance @ LUMINANCE
    unit = directions[window].reshape(-1, 3).astype(np.float64)
    centroid = weight @ unit
    length = np.linalg.norm(centroid)
    toward = centroid / length if length > 1e-9 * weight.sum() else unit[int(np.argmax(weight))]
    distance = np.linalg.norm(unit - toward, axis=1)
    angle = 2 * np.arcsin(np.minimum(distance / 2, 1))
    radius = np.sqrt(2 * (weight @ angle**2) / weight.sum())
    return RegionLight(toward, radiance.sum(axis=0), float(min(radius, np.pi / 2)))


def _turned(light: RegionLight, world_from_map: Float64[np.ndarray, "3 3"]) -> RegionLight:
    return RegionLight(world_from_map @ light.toward, light.irradiance, light.angular_radius_rad)
