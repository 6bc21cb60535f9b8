"""The grid of a radiance map: the hemisphere about +z on a square, octahedral (Cigolle et al. 2014, "hemi-oct").

Texel (row j, column i) of an n x n map has its centre at uv = ((i + 0.5)/n, (j + 0.5)/n). With p = 2 uv - 1,
x = (px + py)/2 and y = (px - py)/2 the direction is that of (x, y, 1 - |x| - |y|): +z is in the centre, the
horizon is the border.
"""

from functools import cache

import numpy as np
from jaxtyping import Float, Float32, Float64


def hemisphere_direction(uv: Float[np.ndarray, "*shape 2"]) -> Float64[np.ndarray, "*shape 3"]:
    """Returns the unit direction (z >= 0) of map coordinates in 0..1."""
    point = _octahedron_point(uv)
    return np.asarray(point / np.linalg.norm(point, axis=-1, keepdims=True))


def hemisphere_uv(direction: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape 2"]:
    """Returns the map coordinates of directions of any length; meaningless where z < 0."""
    d = np.asarray(direction)
    x, y, z = np.moveaxis(d, -1, 0)
    scale = np.abs(x) + np.abs(y) + z
    return np.stack([(x + y) / scale, (x - y) / scale], axis=-1) / 2 + 0.5


@cache
def texel_directions(size: int) -> Float32[np.ndarray, "n n 3"]:
    """Returns the unit direction through every texel's centre (read-only)."""
    return _frozen(hemisphere_direction(_grid(size)))


@cache
def texel_solid_angles(size: int) -> Float32[np.ndarray, "n n"]:
    """Returns the solid angle of every texel, sr (read-only); they add up to 2 pi.

    A patch dA of the octahedron seen from the centre at distance r has dA cos / r^2, proportional to r^-3.
    """
    fine = max(1, 512 // size)
    weight = np.linalg.norm(_octahedron_point(_grid(size * fine)), axis=-1) ** -3
    weight = weight.reshape(size, fine, size, fine).mean(axis=(1, 3))
    return _frozen(weight * (2 * np.pi / weight.sum()))


def _octahedron_point(uv: Float[np.ndarray, "*shape 2"]) -> Float64[np.ndarray, "*shape 3"]:
    p = 2 * np.asarray(uv, np.float64) - 1
    x, y = (p[..., 0] + p[..., 1]) / 2, (p[..., 0] - p[..., 1]) / 2
    return np.stack([x, y, 1 - np.abs(x) - np.abs(y)], axis=-1)


def _grid(size: int) -> Float64[np.ndarray, "n n 2"]:
    centres = (np.arange(size) + 0.5) / size
    return np.stack(np.meshgrid(centres, centres), axis=-1)


def _frozen(values: Float64[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    result = values.astype(np.float32)
    result.flags.writeable = False
    return result
