"""Kannala & Brandt's fish-eye lens (2006, four coefficients; OpenCV's `fisheye`), also beyond 90 degrees."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
from jaxtyping import Float64
from numpy.polynomial.polynomial import polyval

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.radial_lens import RadialLens, RisingCurve, first_root, require_image_circle


@dataclass(frozen=True, eq=False)
class EquidistantLens(RadialLens):
    """Radius / focal length = a + k1 a^3 + k2 a^5 + k3 a^7 + k4 a^9 of the angle a from the axis.

    Unlike `CameraModel`, whose rays are (x/z, y/z), it has directions at and beyond 90 degrees; its largest angle is
    where the polynomial stops rising.

    Raises:
        DeltalightError: the camera is not `equidistant`, or its numbers are impossible.
    """

    camera: CameraModel
    image_circle: float | None = None
    width: int = field(init=False)
    height: int = field(init=False)
    centre: tuple[float, float] = field(init=False)

    def __post_init__(self) -> None:
        if self.camera.distortion_model != "equidistant":
            raise DeltalightError(
                f"a fish-eye lens cannot be `{self.camera.distortion_model}`; "
                "calibrate it as `equidistant` or `ocam`."
            )
        object.__setattr__(self, "image_circle", require_image_circle(self.image_circle))
        object.__setattr__(self, "width", self.camera.width)
        object.__setattr__(self, "height", self.camera.height)
        object.__setattr__(self, "centre", tuple(float(v) for v in self.camera.matrix[:2, 2]))
        self._require_range()

    @property
    def largest_radius(self) -> float:
        """Radius where the polynomial stops rising, or that of 180 degrees; in focal lengths."""
        return float(self._curve.value(np.array(self._curve.end)))

    @cached_property
    def _curve(self) -> RisingCurve:
        given = np.asarray(self.camera.distortion)
        powers = np.concatenate([[1.0], given if given.size else np.zeros(4)])
        slope = powers * np.arange(1, 10, 2)
        end = np.sqrt(first_root(slope, np.pi**2))
        return RisingCurve(
            lambda angle: np.asarray(angle * polyval(angle**2, powers)),
            lambda angle: np.asarray(polyval(angle**2, slope)),
            end,
        )

    def _plane(self, pixels: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        return np.asarray((pixels - self.centre) / self.camera.matrix[[0, 1], [0, 1]])

    def _pixels(self, plane: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        return np.asarray(plane * self.camera.matrix[[0, 1], [0, 1]] + self.centre)

    def _angle(self, radius: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        return self._curve.inverse(radius)

    def _radius(self, angle: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
        return self._curve.value(angle)

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values that msgpack, JSON and YAML can hold."""
        return {**self.camera.to_dict(), "image_circle": self.image_circle}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Creates the lens from the data of `to_dict`.

        Raises:
            DeltalightError: a key is missing or has an impossible value.
        """
        return cls(CameraModel.from_dict(data), data.get("image_circle"))
