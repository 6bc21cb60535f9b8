"""Radiance of a hemisphere, and its resampling to the sphere in world axes."""

from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from typing import Self

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64

from deltalight.protocol.frames import RadianceMap
from deltalight.protocol.hemisphere import hemisphere_uv, texel_directions, texel_solid_angles
from deltalight.protocol.median_cut import SkyGrid
from deltalight.protocol.octahedral import octahedral_grid, sample_at, texel_coordinates, texel_weights
from deltalight.protocol.octahedral import texel_solid_angles as octahedral_solid_angles

COARSE_SIZE = 32
# Power of the cosine that weights visible directions for an unseen one: half at 24 degrees, about the size of parts
# of a room (a wall, a window, the ceiling).
LOBE_POWER = 8
# Weight of all visible directions: decides only where none is close.
MIN_LOBE_WEIGHT = 1e-4


@dataclass(frozen=True, eq=False)
class HemisphereMap:
    """Radiance on the grid of `deltalight.protocol.hemisphere`, 0 where not `seen`.

    `world_from_map` is a rotation.
    """

    radiance: Float32[np.ndarray, "n n 3"]
    seen: Bool[np.ndarray, "n n"]
    world_from_map: Float64[np.ndarray, "3 3"]

    @classmethod
    def of(cls, radiance_map: RadianceMap) -> Self:
        """Builds from a fish-eye camera's radiance map."""
        radiance = radiance_map.radiance * radiance_map.seen[..., None]
        return cls(radiance, radiance_map.seen, np.asarray(radiance_map.world_from_fisheye[:3, :3]))

    @property
    def grid(self) -> SkyGrid:
        """Directions and solid angles of the pixels."""
        return _grid(len(self.radiance))

    @cached_property
    def known_solid_angle(self) -> float:
        """Solid angle of what was seen, sr."""
        return float(self.grid.solid_angles[self.seen].sum(dtype=np.float64))

    def with_radiance(self, radiance: Float32[np.ndarray, "n n 3"]) -> Self:
        """Returns the map with other radiance."""
        return replace(self, radiance=radiance)


@cache
def _grid(size: int) -> SkyGrid:
    return SkyGrid(texel_directions(size), texel_solid_angles(size))


@dataclass(frozen=True, eq=False)
class WorldSky:
    """A map on an octahedral grid in world axes: radiance times the fraction of each texel that is `seen`."""

    radiance: Float32[np.ndarray, "m m 3"]
    seen: Float32[np.ndarray, "m m 1"]

    def filled(self) -> Float32[np.ndarray, "m m 3"]:
        """Returns radiance in all directions; unseen ones get the weighted mean of nearby seen ones."""
        return np.asarray(self.radiance + (1 - self.seen) * _nearby_mean(self.radiance, self.seen))


def to_world(sky: HemisphereMap, size: int) -> WorldSky:
    """Averages a map over the texels of an octahedral grid in world axes."""
    place, weight = _sampling(sky.world_from_map.astype(np.float64).tobytes(), len(sky.radiance), size)
    rgbs = np.dstack([sky.radiance, sky.seen.astype(np.float32)])
    samples = cv2.remap(rgbs, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    samples *= weight[..., None]
    mean = cv2.resize(samples, (size, size), interpolation=cv2.INTER_AREA)
    return WorldSky(np.ascontiguousarray(mean[..., :3]), np.minimum(mean[..., 3:], 1))


@lru_cache(maxsize=4)
def _sampling(
    rotation: bytes, map_size: int, size: int
) -> tuple[Float32[np.ndarray, "k k 2"], Float32[np.ndarray, "k k"]]:
    """Returns where to read a map for each sample of the octahedral grid, and the sample's weight (0 behind).

    Samples are half as far apart as the map's texels, with at least 2x2 per texel of the grid.
    """
    fine = size * max(2, 2 * map_size // size)
    world_from_map = np.frombuffer(rotation).reshape(3, 3)
    directions = octahedral_grid(fine) @ world_from_map
    in_front = directions[..., 2] >= 0
    directions[..., 2] = np.maximum(directions[..., 2], 0)
    place = (hemisphere_uv(directions) * map_size - 0.5).astype(np.float32)
    return place, np.asarray(texel_weights(size, fine // size) * in_front.astype(np.float32))


def _nearby_mean(
    radiance: Float32[np.ndarray, "m m 3"], seen: Float32[np.ndarray, "m m 1"]
) -> Float32[np.ndarray, "m m 3"]:
    """Returns the mean seen radiance around each direction, weighted by a power of the cosine."""
    size = len(radiance)
    coarse = min(size, COARSE_SIZE)
    both = np.dstack([radiance, seen]) * texel_weights(coarse, size // coarse)[..., None]
    small = cv2.resize(both, (coarse, coarse), interpolation=cv2.INTER_AREA)
    sums = _lobe_weights(coarse) @ (small * octahedral_solid_angles(coarse)[..., None]).reshape(-1, 4)
    mean = sums[:, :3] / np.maximum(sums[:, 3:], 1e-12)
    return sample_at(mean.reshape(coarse, coarse, 3), _coarse_coordinates(size, coarse))


@cache
def _coarse_coordinates(size: int, coarse: int) -> Float32[np.ndarray, "m m 2"]:
    """Returns where to read a coarse map for the texels of a finer one."""
    return texel_coordinates(octahedral_grid(size), coarse)


@cache
def _lobe_weights(size: int) -> Float32[np.ndarray, "k k"]:
    directions = octahedral_grid(size).reshape(-1, 3)
    lobe = np.maximum(directions @ directions.T, 0) ** LOBE_POWER
    return np.asarray(lobe + MIN_LOBE_WEIGHT, np.float32)
