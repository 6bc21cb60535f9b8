"""Splitting a map of radiance into a few distant lights and a smooth residual (docs/method.md 2)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, Protocol, Self, TypeVar

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol.frames import LUMINANCE
from deltalight.protocol.sky_lights import Region

PEAK_THRESHOLD = 4.0
MIN_FRACTION = 0.01
# Regions of this angular radius are not cut again: sampling the disc of a light resolves the rest.
MIN_RADIUS_RAD = float(np.radians(5.0))
# Wider regions are not one lamp, and no disc: as little of them as possible becomes a light.
MAX_LAMP_RADIUS_RAD = float(np.radians(15.0))
OcclusionTest = Callable[[Float64[np.ndarray, "3"]], bool]


@dataclass(frozen=True, eq=False)
class SkyGrid:
    """Unit direction (map axes) and solid angle (sr) of every pixel of a map."""

    directions: Float32[np.ndarray, "h w 3"]
    solid_angles: Float32[np.ndarray, "h w"]

    @cached_property
    def moments(self) -> Float32[np.ndarray, "h w 4"]:
        """Solid angle, and solid angle times direction, of every pixel."""
        parts = [np.ones_like(self.solid_angles)[..., None], self.directions]
        return np.asarray(np.concatenate(parts, axis=-1) * self.solid_angles[..., None])


class SkyMap(Protocol):
    """Radiance by direction on some grid; `world_from_map` is a rotation."""

    @property
    def radiance(self) -> Float32[np.ndarray, "h w 3"]:
        """Linear R G B, 0 where nothing is known."""
        ...

    @property
    def world_from_map(self) -> Float64[np.ndarray, "3 3"]:
        """Axes of the grid's directions."""
        ...

    @property
    def grid(self) -> SkyGrid:
        """Directions and solid angles of the pixels."""
        ...

    @property
    def known_solid_angle(self) -> float:
        """Solid angle of what the map knows, sr."""
        ...

    def with_radiance(self, radiance: Float32[np.ndarray, "h w 3"]) -> Self:
        """Returns the map with other radiance."""
        ...


MapT = TypeVar("MapT", bound=SkyMap)


@dataclass(frozen=True, eq=False)
class RegionLight:
    """Light of a region: unit direction to it (world), irradiance across the beam.

    `region` holds in the grid of the split's residual.
    """

    to_light: Float64[np.ndarray, "3"]
    irradiance: Float64[np.ndarray, "3"]
    angular_radius_rad: float
    region: Region


@dataclass(frozen=True, eq=False)
class Split(Generic[MapT]):
    """Lights and residual of a map, which together are the map."""

    lights: tuple[RegionLight, ...]
    residual: MapT


def split_map(
    sky: MapT,
    count: int = 4,
    *,
    threshold: float = PEAK_THRESHOLD,
    whole_map: bool = False,
    is_occluded: OcclusionTest | None = None,
) -> Split[MapT]:
    """Splits a map into at most `count` lights and a residual (docs/method.md 2).

    What is brighter than c, `threshold` times the solid-angle mean of what is known, is cut into regions. Each
    becomes a light, and leaves the mean of everything darker in the residual; one wider than 15 degrees, which is no
    lamp, leaves c. Regions under 1 % of the map's energy go back to the residual, and so do those whose direction
    (unit, world) `is_occluded`. With `whole_map`, as in the papers, everything but occluded regions is cut.
    """
    luminance = luminance_of(sky.radiance)
    energy = float(np.vdot(luminance, sky.grid.solid_angles))
    limit = 0.0 if whole_map else threshold * energy / max(sky.known_solid_angle, 1e-9)
    least = 0.0 if whole_map else MIN_FRACTION * energy
    surroundings = _mean_below(sky, luminance, limit)
    frame = _bounding(luminance, limit, Region(0, luminance.shape[0], 0, luminance.shape[1]))
    residual = sky.radiance.copy()
    lights = []
    above = np.maximum(luminance[frame.window] - np.float32(limit), 0)
    for part in variance_cut(above[..., None] * sky.grid.moments[frame.window], count):
        region = _bounding(luminance, limit, _moved(part, frame))
        peaks = _peaks(sky, luminance, region, limit, surroundings)
        light = _region_light(sky, region, peaks)
        if light.angular_radius_rad > MAX_LAMP_RADIUS_RAD:
            peaks = _peaks(sky, luminance, region, limit, limit)
            light = _region_light(sky, region, peaks)
        occluded = is_occluded is not None and is_occluded(light.to_light)
        if not occluded and light.irradiance @ LUMINANCE >= least:
            lights.append(light)
            residual[region.window] -= peaks
    return Split(tuple(lights), sky.with_radiance(residual))


def luminance_of(radiance: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Returns the luminance of every pixel (ITU-R BT.709)."""
    return np.asarray(cv2.transform(radiance, LUMINANCE[None]), np.float32)


def _mean_below(sky: SkyMap, luminance: Float32[np.ndarray, "h w"], limit: float) -> float:
    """Returns the mean luminance of the known directions that are not above the limit; 0 if there are none."""
    above = (luminance > np.float32(limit)).astype(np.float32)
    solid_angles = sky.grid.solid_angles
    known = sky.known_solid_angle - float(np.vdot(above, solid_angles))
    energy = float(np.vdot(luminance * (1 - above), solid_angles))
    return min(energy / known, limit) if known > 0 else 0.0


def _peaks(
    sky: SkyMap, luminance: Float32[np.ndarray, "h w"], region: Region, limit: float, left: float
) -> Float32[np.ndarray, "a b 3"]:
    """Returns the radiance of a region's pixels above the limit without the luminance that is left there."""
    bright = luminance[region.window]
    taken = np.where(bright > np.float32(limit), bright - np.float32(left), 0)
    return np.asarray(
        sky.radiance[region.window] * (taken / np.maximum(bright, np.float32(1e-30)))[..., None]
    )


def _bounding(luminance: Float32[np.ndarray, "h w"], limit: float, region: Region) -> Region:
    """Returns the least rectangle around a region's pixels above the limit; empty if there are none."""
    above = cv2.compare(luminance[region.window], limit, cv2.CMP_GT)
    left, top, width, height = cv2.boundingRect(above)
    return _moved(Region(top, top + height, left, left + width), region)


def _moved(region: Region, origin: Region) -> Region:
    top, left = origin.top, origin.left
    return Region(region.top + top, region.bottom + top, region.left + left, region.right + left)


def _region_light(sky: SkyMap, region: Region, peaks: Float32[np.ndarray, "h w 3"]) -> RegionLight:
    """Integrates a region: E = sum P dw, centroid, radius = sqrt(2 mean squared angle) (a disc's own radius)."""
    directions = sky.grid.directions[region.window]
    solid_angles = sky.grid.solid_angles[region.window]
    weight = (luminance_of(peaks) * solid_angles).ravel()
    energy = float(weight.sum(dtype=np.float64))
    pull = (weight @ directions.reshape(-1, 3)).astype(np.float64)
    length = float(np.linalg.norm(pull))
    brightest = directions.reshape(-1, 3)[int(np.argmax(weight))].astype(np.float64)
    to_light = pull / length if length > 1e-6 * energy else brightest
    cosine = cv2.transform(directions, to_light.astype(np.float32)[None]).ravel()
    angle = np.arccos(np.clip(cosine, -1, 1))
    radius = np.sqrt(2 * np.vdot(weight, angle**2) / energy)
    irradiance = solid_angles.ravel() @ peaks.reshape(-1, 3)
    return RegionLight(
        sky.world_from_map @ to_light,
        irradiance.astype(np.float64),
        float(min(radius, np.pi / 2)),
        region,
    )


def variance_cut(moments: Float32[np.ndarray, "h w 4"], count: int) -> list[Region]:
    """Variance-minimised median cut (Viriyothai & Debevec 2009) of a weighted set of directions.

    `moments` holds each pixel's weight and weight times direction. Again and again the region with the greatest
    weighted squared distance to its centroid is cut, across rows or columns, where the two sides' squared
    distances add up to least. Regions without weight are left out, and cutting stops early once every region's
    angular radius is at most 5 degrees.
    """
    if not moments.size:
        return []
    table = _Table(cv2.integral(moments, sdepth=cv2.CV_64F))
    regions = [Region(0, moments.shape[0], 0, moments.shape[1])]
    spreads = [table.spread(regions[0])]
    while len(regions) < count:
        widest = int(np.argmax(spreads))
        halves = table.halves(regions[widest]) if spreads[widest] > 0 else None
        if halves is None:
            break
        regions[widest : widest + 1] = halves
        spreads[widest : widest + 1] = [table.spread(half) for half in halves]
    return [region for region in regions if table.sums(region)[0] > 0]


@dataclass(frozen=True, eq=False)
class _Table:
    """Summed areas of weight and weighted direction."""

    values: Float64[np.ndarray, "a b 4"]

    def sums(self, region: Region) -> Float64[np.ndarray, "4"]:
        lower, upper = self.values[region.bottom], self.values[region.top]
        return np.asarray(lower[region.right] - lower[region.left] - upper[region.right] + upper[region.left])

    def spread(self, region: Region) -> float:
        """Returns the spread of a region that is worth cutting, else 0."""
        sums = self.sums(region)
        spread = float(_spread(sums))
        # Radius as of a light: sqrt(2 mean squared angle).
        return 0.0 if 2 * spread <= MIN_RADIUS_RAD**2 * sums[0] else spread

    def halves(self, region: Region) -> tuple[Region, Region] | None:
        """Cuts a region where the sum of both sides' spreads is least; None for a single pixel."""
        top, bottom, left, right = region.top, region.bottom, region.left, region.right
        row = _best_cut(self.values[top : bottom + 1, right] - self.values[top : bottom + 1, left])
        column = _best_cut(self.values[bottom, left : right + 1] - self.values[top, left : right + 1])
        if row is None and column is None:
            return None
        if column is None or (row is not None and row[1] <= column[1]):
            assert row is not None
            cut = top + row[0]
            return Region(top, cut, left, right), Region(cut, bottom, left, right)
        cut = left + column[0]
        return Region(top, bottom, left, cut), Region(top, bottom, cut, right)


def _best_cut(running: Float64[np.ndarray, "n 4"]) -> tuple[int, float] | None:
    """Returns where to cut a row of running sums, and the spread of both sides; None if it cannot be cut."""
    if len(running) < 3:
        return None
    before = running[1:-1] - running[0]
    costs = _spread(before) + _spread(running[-1] - running[1:-1])
    best = int(np.argmin(costs))
    return best + 1, float(costs[best])


def _spread(moments: Float64[np.ndarray, "*n 4"]) -> Float64[np.ndarray, "*n"]:
    """Returns the weighted sum of squared distances of unit vectors to their centroid: W - |sum w d|^2 / W."""
    weight = moments[..., 0]
    pull = np.einsum("...i,...i", moments[..., 1:], moments[..., 1:])
    return np.asarray(np.maximum(weight - pull / np.maximum(weight, 1e-300), 0))
