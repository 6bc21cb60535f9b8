"""Lights that a fish-eye camera sees, and where its map of radiance was cut to find them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64


@dataclass(frozen=True)
class Region:
    """A rectangle of a map's grid: rows and columns from..to (exclusive)."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def window(self) -> tuple[slice, slice]:
        """The region as an index."""
        return np.s_[self.top : self.bottom, self.left : self.right]


@dataclass(frozen=True, eq=False)
class TrackedLight:
    """A distant light with an identity: unit direction to it (world), irradiance across the beam."""

    identity: int
    to_light: Float64[np.ndarray, "3"]
    irradiance: Float64[np.ndarray, "3"]
    angular_radius_rad: float
