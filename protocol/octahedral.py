"""Maps of the whole sphere on a square: the octahedral mapping, resampling.

Texel (row j, column i) of an n x n map has its centre at uv = ((i + 0.5)/n, (j + 0.5)/n). With
p = 2 uv - 1 the direction is (px, py, 1 - |px| - |py|) where |px| + |py| <= 1 (upper half, +z in the centre);
beyond, the corners are folded down (Engelhardt & Dachsbacher 2008). Axes are world axes.
"""

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

SUPERSAMPLING = 2  # samples along each edge of a texel
SampleMap = Callable[[Float32[np.ndarray, "n m 3"]], Float32[np.ndarray, "n m c"]]


def octahedral_direction(uv: Float[np.ndarray, "*shape 2"]) -> Float64[np.ndarray, "*shape 3"]:
    """Returns the unit direction of map coordinates in 0..1."""
    folded = _folded_direction(uv)
    return np.asarray(folded / np.linalg.norm(folded, axis=-1, keepdims=True))


def _folded_direction(uv: Float[np.ndarray, "*shape 2"]) -> Float64[np.ndarray, "*shape 3"]:
    """Returns the point of the octahedron |x| + |y| + |z| = 1."""
    p = 2 * np.asarray(uv, np.float64) - 1
    z = 1 - np.abs(p).sum(axis=-1)
    below = np.maximum(-z, 0)[..., None]
    return np.concatenate([p - np.copysign(below, p), z[..., None]], axis=-1)


def octahedral_uv(direction: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape 2"]:
    """Returns the map coordinates in 0..1 of directions of any length.

    Components apart take numpy half the time that vectors of three do.
    """
    x, y, z = np.moveaxis(np.asarray(direction), -1, 0)
    length = np.abs(x) + np.abs(y) + np.abs(z)
    u, v, is_below = x / length, y / length, z / length < 0
    uv = np.empty((*u.shape, 2), u.dtype)
    uv[..., 0] = np.where(is_below, np.copysign(1 - np.abs(v), u), u)
    uv[..., 1] = np.where(is_below, np.copysign(1 - np.abs(u), v), v)
    uv /= 2
    uv += 0.5
    return uv


def octahedral_texels(direction: Float[np.ndarray, "*shape 3"], size: int) -> Int64[np.ndarray, "*shape 2"]:
    """Returns column and row of the texels of a size x size map in which directions of any length lie."""
    return np.minimum((octahedral_uv(direction) * size).astype(np.int64), size - 1)


@cache
def octahedral_grid(size: int) -> Float64[np.ndarray, "n n 3"]:
    """Returns the unit directions of the texel centres of a size x size map (read-only)."""
    directions = octahedral_direction(_grid_uv(size))
    directions.flags.writeable = False
    return directions


@cache
def texel_weights(size: int, supersampling: int) -> Float32[np.ndarray, "k k"]:
    """Returns the solid angles of supersampling^2 samples per texel, relative to the mean of their texel."""
    weight = np.linalg.norm(_folded_direction(_grid_uv(size * supersampling)), axis=-1) ** -3
    mean = weight.reshape(size, supersampling, size, supersampling).mean(axis=(1, 3))
    return np.asarray(weight / mean.repeat(supersampling, 0).repeat(supersampling, 1), np.float32)


def _grid_uv(size: int) -> Float64[np.ndarray, "n n 2"]:
    centres = (np.arange(size) + 0.5) / size
    return np.stack(np.meshgrid(centres, centres), axis=-1)


@cache
def texel_solid_angles(size: int) -> Float32[np.ndarray, "n n"]:
    """Returns the solid angle of every texel, sr; they add up to 4 pi.

    A patch dA of the octahedron seen from the centre at distance r has dA cos / r^2, proportional to r^-3.
    """
    fine = max(1, 256 // size)
    weight = np.linalg.norm(_folded_direction(_grid_uv(size * fine)), axis=-1) ** -3
    weight = weight.reshape(size, fine, size, fine).mean(axis=(1, 3))
    weight = (weight * (4 * np.pi / weight.sum())).astype(np.float32)
    weight.flags.writeable = False
    return np.asarray(weight)


def resample_to_octahedral(sample: SampleMap, size: int) -> np.ndarray:
    """Averages a radiance function over the texels of an octahedral map, weighted by solid angle.

    `sample` maps directions (n, m, 3) to radiance (n, m, c); every texel takes SUPERSAMPLING^2 of them.
    """
    uv = _grid_uv(size * SUPERSAMPLING)
    folded = _folded_direction(uv)
    weight = (np.linalg.norm(folded, axis=-1, keepdims=True) ** -3).astype(np.float32)
    weighted = sample(folded.astype(np.float32)) * weight
    blocks = (size, SUPERSAMPLING, size, SUPERSAMPLING, -1)
    total = weighted.reshape(blocks).sum(axis=(1, 3)) / weight.reshape(blocks).sum(axis=(1, 3))
    return np.asarray(total, np.float32)


def sample_octahedral(
    radiance: Float32[np.ndarray, "n n 3"], directions: Float[np.ndarray, "a b 3"]
) -> Float32[np.ndarray, "a b 3"]:
    """Reads a map bilinearly; interpolation continues across the map's border."""
    return sample_at(radiance, texel_coordinates(directions, len(radiance)))


def texel_coordinates(directions: Float[np.ndarray, "a b 3"], size: int) -> Float32[np.ndarray, "a b 2"]:
    """Returns where `sample_at` reads a map of this size for directions."""
    return (octahedral_uv(directions) * size + 0.5).astype(np.float32)


def resize_octahedral(radiance: Float32[np.ndarray, "n n 3"], size: int) -> Float32[np.ndarray, "m m 3"]:
    """Reads a map bilinearly at the texel centres of one of another size."""
    return sample_at(radiance, _grid_coordinates(size, len(radiance)))


@cache
def _grid_coordinates(size: int, source_size: int) -> Float32[np.ndarray, "n n 2"]:
    coordinates = texel_coordinates(octahedral_grid(size), source_size)
    coordinates.flags.writeable = False
    return coordinates


def sample_at(
    radiance: Float32[np.ndarray, "n n 3"], coordinates: Float32[np.ndarray, "a b 2"]
) -> Float32[np.ndarray, "a b 3"]:
    """Reads a map bilinearly at coordinates that `texel_coordinates` returned."""
    return np.asarray(cv2.remap(_bordered(radiance), coordinates, None, cv2.INTER_LINEAR))


def _bordered(radiance: Float32[np.ndarray, "n n 3"]) -> Float32[np.ndarray, "m m 3"]:
    """Adds a border of one texel: across an edge of the map lies the same edge, mirrored about its middle."""
    rows = np.concatenate([radiance[:1, ::-1], radiance, radiance[-1:, ::-1]])
    left, right = rows[::-1, :1].copy(), rows[::-1, -1:].copy()
    return np.ascontiguousarray(np.concatenate([left, rows, right], axis=1))
