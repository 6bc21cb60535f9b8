"""Scaramuzza's omnidirectional lens (OCamCalib, 2006): z is a polynomial of the radius in the picture."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from jaxtyping import Float64
from numpy.polynomial.polynomial import polyder, polyval

from deltalight.protocol.camera_model import MAX_EDGE
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.radial_lens import RadialLens, RisingCurve, first_root, require_image_circle


@dataclass(frozen=True, eq=False)
class OcamLens(RadialLens):
    """The ray through (x, y) of the lens's plane is (x, y, polynomial(hypot(x, y))), all in pixels.

    `polynomial` has its coefficients from power 0 up; the first is above 0 (OCamCalib's axis points backwards, so its
    files have all of them negated). `centre` is the pixel (x, y) on the axis. `affine` is OCamCalib's (c, d, e), row
    = c y + d x + centre row, column = e y + x + centre column.

    Raises:
        DeltalightError: the numbers are impossible.
    """

    width: int
    height: int
    polynomial: tuple[float, ...]
    centre: tuple[float, float]
    affine: tuple[float, float, float] = (1.0, 0.0, 0.0)
    image_circle: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "image_circle", require_image_circle(self.image_circle))
        if not (1 <= self.width <= MAX_EDGE and 1 <= self.height <= MAX_EDGE):
            raise DeltalightError(
                f"a lens's picture of {self.width}x{self.height} pixels is outside 1..{MAX_EDGE}; correct its size."
            )
        if len(self.centre) != 2 or len(self.affine) != 3 or not self.polynomial:
            raise DeltalightError(
                "an ocam lens needs `polynomial`, `center` [x, y] and `affine` [c, d, e]; correct the calibration."
            )
        if not np.isfinite([*self.polynomial, *self.centre, *self.affine]).all():
            raise DeltalightError("an ocam lens holds a number that is not finite; correct the calibration.")
        if self.polynomial[0] <= 0 or abs(np.linalg.det(self._affine_matrix)) < 1e-3:
            raise DeltalightError(
                "an ocam lens needs a polynomial that begins above 0 and an affine part that can be inverted; "
                "correct the calibration."
            )
        self._require_range()

    @cached_property
    def _affine_matrix(self) -> Float64[np.ndarray, "2 2"]:
        c, d, e = self.affine
        return np.array([[1.0, e], [d, c]])

    @cached_property
    def largest_radius(self) -> float:
        """Radius where the angle stops rising, or that of the farthest corner of the picture; in pixels."""
        polynomial = np.array(self.polynomial)
        corners = np.array([[x, y] for x in (-0.5, self.width - 0.5) for y in (-0.5, self.height - 0.5)])
        farthest = np.linalg.norm(self._plane(corners), axis=1).max()
        # The slope of atan2(r, p(r)) has the sign of p - r p', whose coefficients are (1 - k) p_k.
        return first_root(polynomial * (1 - np.arange(len(polynomial))), float(farthest))

    @cached_property
    def _curve(self) -> RisingCurve:
        """Angle as a function of the radius."""
        polynomial = np.array(self.polynomial)
        derivative = polyder(polynomial)

        def slope(radius: Float64[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
            z = polyval(radius, polynomial)
            return np.asarray((z - radius * polyval(radius, derivative)) / (radius**2 + z**2))

        return RisingCurve(
            lambda radius: np.asarray(np.arctan2(radius, polyval(radius, polynomial))),
            slope,
            self.largest_radius,
        )

    def _plane(self, pixels: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        return np.asarray((pixels - self.centre) @ np.linalg.inv(self._affine_matrix).T)

    def _pixels(self, plane: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        return np.asarray(plane @ self._affine_matrix.T + self.centre)

    def _angle(self, radius: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        return self._curve.value(radius)

    def _radius(self, angle: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        return self._curve.inverse(angle)

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values that msgpack, JSON and YAML can hold."""
        return {
            "width": self.width,
            "height": self.height,
            "distortion_model": "ocam",
            "polynomial": list(self.polynomial),
            "center": list(self.centre),
            "affine": list(self.affine),
            "image_circle": self.image_circle,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Creates the lens from the data of `to_dict`; a polynomial with OCamCalib's sign is negated.

        Raises:
            DeltalightError: a key is missing or has an impossible value.
        """
        try:
            polynomial = [float(v) for v in data["polynomial"]]
            sign = -1.0 if polynomial and polynomial[0] < 0 else 1.0
            x, y = (float(v) for v in data["center"])
            c, d, e = (float(v) for v in data.get("affine") or (1.0, 0.0, 0.0))
            size = int(data["width"]), int(data["height"])
        except (KeyError, TypeError, ValueError) as error:
            raise DeltalightError(
                f"an ocam lens is malformed ({error!r:.300}); give polynomial, center, affine, width and height."
            ) from error
        coefficients = tuple(sign * v for v in polynomial)
        return cls(*size, coefficients, (x, y), (c, d, e), data.get("image_circle"))


def load_ocam_results(path: Path) -> OcamLens:
    """Reads OCamCalib's calib_results.txt.

    Its five number lines are the polynomial (count first; its axis points backwards), the inverse polynomial (unused:
    the exact inverse is computed), the centre as row and column counted from 0, c d e, and height and width. So a
    pixel here is (column, row), without an offset.

    Raises:
        DeltalightError: the file is unreadable or has other contents.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise DeltalightError(
            f"{path} cannot be read ({error.strerror}); give a file that exists."
        ) from error
    lines = [line for line in text.splitlines() if line.strip() and not re.match(r"\s*#", line)]
    try:
        direct, _, centre, affine, size = ([float(word) for word in line.split()] for line in lines[:5])
        row, column = centre
        height, width = (int(v) for v in size)
        if len(direct) != 1 + direct[0]:
            raise ValueError("the polynomial's count is wrong")
    except ValueError as error:
        raise DeltalightError(
            f"{path} is not a calib_results.txt of OCamCalib ({error}); export it from the toolbox again."
        ) from error
    data = {"polynomial": direct[1:], "center": [column, row], "affine": affine}
    return OcamLens.from_dict({**data, "width": width, "height": height})
