"""Real spherical harmonics up to band 4, as polynomials of the direction (Sloan 2008, appendix A2)."""

import math

import numpy as np
from jaxtyping import Float, Float64

MAX_ORDER = 5


def _constant(numerator: float, denominator: float) -> float:
    return math.sqrt(numerator / (denominator * math.pi))


def harmonics(directions: Float[np.ndarray, "n 3"], order: int) -> Float64[np.ndarray, "n k"]:
    """Return the basis functions at unit directions: k = order^2, index l^2 + l + m, orthonormal over the sphere.

    The same polynomials stand in passes/common/harmonics.glsl.
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


def even_directions(count: int) -> Float64[np.ndarray, "count 3"]:
    """Return unit directions of equal shares of the sphere (a spiral by the golden angle)."""
    k = np.arange(count)
    z = 1 - (2 * k + 1) / count
    turn = k * math.pi * (3 - math.sqrt(5))
    level = np.sqrt(1 - z * z)
    return np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=1)
