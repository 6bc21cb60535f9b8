"""Common parts of fish-eye lens models: radial symmetry about the axis, image circle, limits of the picture."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64

from deltalight.protocol.errors import DeltalightError

Values = Float64[np.ndarray, "..."]
ROUNDING_PX = 1e-6
"""Tolerance by which the picture's border projects onto itself."""


@dataclass(frozen=True, eq=False)
class RisingCurve:
    """A smooth function that rises from 0 over 0..`end`, with its inverse."""

    value: Callable[[Values], Values]
    slope: Callable[[Values], Values]
    end: float

    @cached_property
    def _table(self) -> tuple[Values, Values]:
        x = np.linspace(0.0, self.end, 1025)
        return x, self.value(x)

    def inverse(self, y: Values) -> Values:
        """Returns x of y; y outside the curve's range gives the nearer end."""
        xs, ys = self._table
        cell = np.clip(np.searchsorted(ys, y), 1, len(xs) - 1)
        low, high = xs[cell - 1], xs[cell]
        x = np.interp(y, ys, xs)
        for _ in range(8):  # linear convergence (halves) only in the last cell, where the slope may vanish
            x = np.clip(x - (self.value(x) - y) / np.maximum(self.slope(x), 1e-12), low, high)
        return np.asarray(x)


class RadialLens(ABC):
    """A lens whose picture is, up to an affine map, symmetric about its optical axis.

    Pixel centres are at integers; the optical frame has x right, y down and z forward. `centre` is the pixel (x, y)
    on the axis. `image_circle` is the radius in pixels about it that light reaches; None: as far as the model goes.

    A model maps pixels to its plane (affine, the centre is 0) and the radius there to the angle from the axis.
    """

    width: int
    height: int
    centre: tuple[float, float]
    image_circle: float | None

    @property
    @abstractmethod
    def largest_radius(self) -> float:
        """Radius in the model's plane up to which the angle rises; it may lie outside the picture."""

    @abstractmethod
    def _plane(self, pixels: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]: ...

    @abstractmethod
    def _pixels(self, plane: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]: ...

    @abstractmethod
    def _angle(self, radius: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]: ...

    @abstractmethod
    def _radius(self, angle: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]: ...

    def directions(self, pixels: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 3"]:
        """Returns unit directions in the optical frame; NaN outside the image circle or the picture."""
        pixels = np.asarray(pixels, np.float64).reshape(-1, 2)
        plane = self._plane(pixels)
        radius = np.linalg.norm(plane, axis=1)
        angle = self._angle(np.minimum(radius, self.largest_radius))
        # sin(angle)/radius has a limit on the axis, where the direction is (0, 0, 1) whatever its value.
        stretch = np.sin(angle) / np.maximum(radius, 1e-12)
        result = np.column_stack([plane * stretch[:, None], np.cos(angle)])
        result[~self.has_ray(pixels)] = np.nan
        return result

    def has_ray(self, pixels: Float64[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """Whether `directions` gives a ray, without computing it."""
        radius = np.linalg.norm(self._plane(pixels), axis=1)
        return np.asarray(self._is_inside(pixels) & (radius <= self.largest_radius))

    def project(self, directions: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
        """Returns the pixels (x, y) of directions of any length; NaN outside the lens or the picture."""
        d = np.asarray(directions, np.float64).reshape(-1, 3)
        across = np.hypot(d[:, 0], d[:, 1])
        angle = np.arctan2(across, d[:, 2])
        radius = self._radius(np.minimum(angle, self._largest_model_angle))
        pixels = self._pixels(d[:, :2] * (radius / np.maximum(across, 1e-300))[:, None])
        known = (angle <= self._largest_model_angle) & ((across > 0) | (d[:, 2] > 0))
        pixels[~(known & self._is_inside(pixels))] = np.nan
        return pixels

    def _require_range(self) -> None:
        """Computes the range of the model, which fails for impossible numbers.

        Raises:
            DeltalightError: the polynomial overflows or does not rise at all.
        """
        with np.errstate(all="ignore"):
            try:
                ends = np.array([self.largest_radius, self._largest_model_angle])
            except (ArithmeticError, ValueError):  # LinAlgError is a ValueError
                ends = np.zeros(2)
        if not (np.isfinite(ends).all() and (ends > 0).all()):
            raise DeltalightError("the fish-eye lens's polynomial goes nowhere; calibrate the lens again.")

    @cached_property
    def _largest_model_angle(self) -> float:
        return float(self._angle(np.array([self.largest_radius]))[0])

    def _is_inside(self, pixels: Float64[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        border = np.array([self.width, self.height]) - 0.5 + ROUNDING_PX
        inside = np.all((pixels >= -0.5 - ROUNDING_PX) & (pixels <= border), axis=1)
        if self.image_circle is not None:
            inside &= np.linalg.norm(pixels - self.centre, axis=1) <= self.image_circle
        return np.asarray(inside)


def require_image_circle(value: object) -> float | None:
    """Returns an image circle's radius in pixels, or None if none is given.

    Raises:
        DeltalightError: it is not a positive number.
    """
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < np.inf:
        raise DeltalightError(f"`image_circle` is {value!r:.60}; give its radius in pixels, above 0.")
    return float(value)


def first_root(polynomial: Float64[np.ndarray, " k"], end: float) -> float:
    """Returns a polynomial's smallest root above 0 (coefficients from power 0 up), or `end` if none is below it."""
    roots = np.polynomial.Polynomial(np.trim_zeros(polynomial, "b")).roots()
    real = roots[np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots.real))].real
    return float(min([end, *real[real > 0]]))
