"""Integrals over octahedral maps: prefiltering by cones, irradiance; spherical harmonics."""

import math
from dataclasses import dataclass
from functools import cache, lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64

from deltalight.protocol.octahedral import (
    octahedral_grid,
    resample_to_octahedral,
    resize_octahedral,
    sample_at,
    texel_coordinates,
    texel_solid_angles,
    texel_weights,
)

MIN_LEVEL_SIZE = 32
SUMMED_SIZE = 64
SUMMED_FROM_RAD = 0.4
CONE_SAMPLES = 64
CACHED_LEVELS = 16
AXES_AT_ONCE = 64  # so that their data stays in the processor's cache
MAX_ORDER = 5


@cache
def above_horizon(size: int) -> Float32[np.ndarray, "n n 1"]:
    """Returns the fraction of each texel above the horizon (+z), blurred by one texel."""
    texel = np.pi / size
    return resample_to_octahedral(lambda d: np.clip(0.5 + d[..., 2:] / texel, 0, 1).astype(np.float32), size)


def solid_angle_mean(radiance: Float32[np.ndarray, "n n 3"]) -> Float64[np.ndarray, "3"]:
    """Returns the mean radiance over the sphere."""
    weights = texel_solid_angles(len(radiance)).astype(np.float64)
    return np.asarray(np.tensordot(weights, radiance, axes=2) / (4 * np.pi))


@dataclass(frozen=True, eq=False)
class PrefilteredMap:
    """An octahedral map averaged over cones; level l holds cones of `half_angles[l]` radians.

    Level 0 is the map itself. From level 1 on the half angle is 2^l texel widths of level 0, the last is
    pi/2; its value is irradiance / pi. A cone of half angle a reads level log2(a / half_angles[0]).
    """

    levels: tuple[Float32[np.ndarray, "n n 3"], ...]
    half_angles: tuple[float, ...]


def prefilter(radiance: Float32[np.ndarray, "n n 3"]) -> PrefilteredMap:
    """Averages a map over cones, weighted by the cosine to the axis (so the widest gives irradiance / pi)."""
    return _prefiltered(radiance) if radiance.any() else _black(len(radiance))


@cache
def _black(size: int) -> PrefilteredMap:
    """Returns a black map, of which nothing has to be averaged; estimates of bounced light ask for it often."""
    angles, sizes = _cones(size)
    return PrefilteredMap(tuple(np.zeros((each, each, 3), np.float32) for each in sizes), angles)


def _cones(size: int) -> tuple[tuple[float, ...], tuple[int, ...]]:
    """Returns half angles (radians) and sizes of all levels of a map of this size."""
    angles, sizes = [float(np.sqrt(4 * np.pi)) / size], [size]
    while angles[-1] < np.pi / 2:
        angles.append(min(2 * angles[-1], np.pi / 2))
        sizes.append(max(size >> len(sizes), min(size, MIN_LEVEL_SIZE)))
    return tuple(angles), tuple(sizes)


def _prefiltered(radiance: Float32[np.ndarray, "n n 3"]) -> PrefilteredMap:
    halved = [radiance]
    while len(halved[-1]) > SUMMED_SIZE // 4:
        halved.append(_halved(halved[-1]))
    summed = next((source for source in halved if len(source) <= SUMMED_SIZE), radiance)
    angles, sizes = _cones(len(radiance))
    levels = [radiance]
    for angle, size in zip(angles[1:], sizes[1:], strict=True):
        is_narrow = angle < SUMMED_FROM_RAD
        levels.append(_cone_average(halved, angle, size) if is_narrow else _cone_sum(summed, angle, size))
    return PrefilteredMap(tuple(levels), angles)


def _halved(radiance: Float32[np.ndarray, "n n 3"]) -> Float32[np.ndarray, "m m 3"]:
    half = len(radiance) // 2
    weighted = radiance * texel_weights(half, 2)[..., None]
    return np.asarray(cv2.resize(weighted, (half, half), interpolation=cv2.INTER_AREA), np.float32)


def _cone_average(
    halved: list[Float32[np.ndarray, "n n 3"]], half_angle: float, size: int
) -> Float32[np.ndarray, "m m 3"]:
    """Averages over a cone about every texel's direction with samples in a spiral over its projected disc.

    Each sample reads the halved map whose texels are about as wide as the samples are apart.
    """
    spacing = 2 * half_angle / np.sqrt(CONE_SAMPLES)
    wanted = np.sqrt(4 * np.pi) / spacing
    source = min(halved, key=lambda level: abs(np.log2(len(level) / wanted)))
    samples = sample_at(source, _cone_coordinates(half_angle, size, len(source)))
    return np.asarray(samples.mean(axis=0).reshape(size, size, 3))


# Maps of one size are filtered repeatedly while lights are tracked, so sample coordinates are cached.
@lru_cache(maxsize=CACHED_LEVELS)
def _cone_coordinates(half_angle: float, size: int, source_size: int) -> Float32[np.ndarray, "k n 2"]:
    frames = _tangent_frames(octahedral_grid(size).reshape(-1, 3)).astype(np.float32)
    spiral = _spiral(np.sin(half_angle)).astype(np.float32)
    coordinates = np.empty((len(spiral), len(frames), 2), np.float32)
    for first in range(0, len(frames), AXES_AT_ONCE):
        part = slice(first, first + AXES_AT_ONCE)
        directions = spiral @ np.swapaxes(frames[part], 1, 2)
        coordinates[:, part] = np.swapaxes(texel_coordinates(directions, source_size), 0, 1)
    return coordinates


def _cone_sum(
    source: Float32[np.ndarray, "n n 3"], half_angle: float, size: int
) -> Float32[np.ndarray, "m m 3"]:
    """Averages over wide cones by the plain sum over all texels of a source map.

    BLAS multiplies by four columns in less time than by three.
    """
    columns = np.zeros((source.shape[0] * source.shape[1], 4), np.float32)
    columns[:, :3] = source.reshape(-1, 3)
    total = (_cone_weights(half_angle, size, len(source)) @ columns)[:, :3]
    return np.asarray(total.reshape(size, size, 3), np.float32)


@lru_cache(maxsize=CACHED_LEVELS)
def _cone_weights(half_angle: float, size: int, source_size: int) -> Float32[np.ndarray, "n k"]:
    axes, source = octahedral_grid(size).reshape(-1, 3), octahedral_grid(source_size).reshape(-1, 3)
    solid_angles, least = texel_solid_angles(source_size).ravel(), np.cos(half_angle)
    weights = np.empty((len(axes), len(source)), np.float32)
    for first in range(0, len(axes), AXES_AT_ONCE):
        part = slice(first, first + AXES_AT_ONCE)
        weight = weights[part]
        weight[:] = axes[part] @ source.T
        weight[weight <= least] = 0
        weight *= solid_angles
        weight /= weight.sum(axis=1, keepdims=True)
    return weights


def _spiral(sin_half_angle: float) -> Float64[np.ndarray, "n 3"]:
    """Returns directions about +z that are uniform over the cone's projected disc (cosine-weighted)."""
    index = np.arange(CONE_SAMPLES) + 0.5
    radius = sin_half_angle * np.sqrt(index / CONE_SAMPLES)
    angle = index * (np.pi * (3 - np.sqrt(5)))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - radius**2)], axis=1)


def _tangent_frames(axis: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3 3"]:
    """Returns rotations whose third column is the axis (Duff et al. 2017)."""
    x, y, z = axis.T
    sign = np.copysign(1.0, z)
    a = -1 / (sign + z)
    b = x * y * a
    columns = [1 + sign * x * x * a, sign * b, -sign * x], [b, sign + y * y * a, -y], [x, y, z]
    return np.stack([np.stack(column, axis=-1) for column in columns], axis=-1)


def irradiance_map(radiance: Float32[np.ndarray, "n n 3"]) -> Float32[np.ndarray, "n n 3"]:
    """Returns the irradiance on a surface that faces each direction, as the widest level of `prefilter` has it."""
    source = radiance
    while len(source) > SUMMED_SIZE:
        source = _halved(source)
    level = np.pi * _cone_sum(source, np.pi / 2, min(len(radiance), MIN_LEVEL_SIZE))
    return resize_octahedral(level, len(radiance))


def irradiance(
    radiance: Float32[np.ndarray, "n n 3"], normals: Float[np.ndarray, "k 3"]
) -> Float64[np.ndarray, "k 3"]:
    """Integrates a map over the hemisphere of each unit normal, by plain summation."""
    weighted = radiance.reshape(-1, 3) * texel_solid_angles(len(radiance)).reshape(-1, 1)
    directions = octahedral_grid(len(radiance)).reshape(-1, 3)
    return np.asarray(np.maximum(normals @ directions.T, 0) @ weighted.astype(np.float64))


def _constant(numerator: float, denominator: float) -> float:
    return math.sqrt(numerator / (denominator * math.pi))


def harmonics(directions: Float[np.ndarray, "n 3"], order: int) -> Float64[np.ndarray, "n k"]:
    """Evaluates real spherical harmonics at unit directions as polynomials (Sloan 2008, appendix A2).

    k = order^2 functions up to band 4, index l^2 + l + m, orthonormal over the sphere; the same polynomials are in
    passes/shaders/common/harmonics.glsl.
    """
    x, y, z = np.asarray(directions, np.float64).T
    x2, y2, z2 = x * x, y * y, z * z
    one = np.ones_like(x)
    c1, c2, c3, c4 = _constant(3, 4), _constant(15, 4), _constant(35, 32), _constant(315, 16)
    functions = [
        _constant(1, 4) * one,
        *(c1 * y, c1 * z, c1 * x),
        *(c2 * x * y, c2 * y * z, _constant(5, 16) * (3 * z2 - 1), c2 * x * z, c2 / 2 * (x2 - y2)),
        *(c3 * y * (3 * x2 - y2), _constant(105, 4) * x * y * z, _constant(21, 32) * y * (5 * z2 - 1)),
        *(_constant(7, 16) * z * (5 * z2 - 3), _constant(21, 32) * x * (5 * z2 - 1)),
        *(_constant(105, 16) * z * (x2 - y2), c3 * x * (x2 - 3 * y2)),
        *(c4 * x * y * (x2 - y2), _constant(315, 32) * y * z * (3 * x2 - y2)),
        *(_constant(45, 16) * x * y * (7 * z2 - 1), _constant(45, 32) * y * z * (7 * z2 - 3)),
        *(_constant(9, 256) * (35 * z2 * z2 - 30 * z2 + 3), _constant(45, 32) * x * z * (7 * z2 - 3)),
        *(_constant(45, 64) * (x2 - y2) * (7 * z2 - 1), _constant(315, 32) * x * z * (x2 - 3 * y2)),
        _constant(315, 256) * (x2 * (x2 - 3 * y2) - y2 * (3 * x2 - y2)),
    ]
    return np.stack(functions[: order**2], axis=1)


def turned_harmonics(rotation: Float64[np.ndarray, "3 3"], order: int) -> Float64[np.ndarray, "k k"]:
    """Returns the matrix that turns coefficients of harmonics: f'(R d) = f(d) for the rotation R.

    Bands turn among themselves, so that their values in more directions than there are functions determine it.
    """
    directions = even_directions(4 * order**2)
    turned, own = harmonics(directions @ rotation.T, order), harmonics(directions, order)
    return np.asarray(np.linalg.lstsq(turned, own)[0])


def even_directions(count: int) -> Float64[np.ndarray, "count 3"]:
    """Returns unit directions of equal solid angle over the sphere (a spiral by the golden angle)."""
    k = np.arange(count)
    z = 1 - (2 * k + 1) / count
    turn = k * math.pi * (3 - math.sqrt(5))
    level = np.sqrt(1 - z * z)
    return np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=1)
