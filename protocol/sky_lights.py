"""Lights that a fish-eye camera sees: its maps of radiance, cut into a few lights and a smooth residual."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol.scene_lights import LightCut


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


@dataclass(frozen=True, eq=False)
class SkyLights:
    """Lights and residual of a fish-eye camera's maps of radiance, tracked over time; in the maps' units.

    Together they are the map, as far as the filter has followed it. `residual` is radiance on an octahedral grid in
    world axes; unseen directions hold what is seen beside them. `seen` is the fraction of each of its texels that the
    newest map shows. `cut` says how they were made. `regions` are where the newest map was cut, on its own grid
    (`deltalight.protocol.hemisphere`); `world_from_fisheye` is its pose.
    """

    cut: LightCut
    world_from_fisheye: Float64[np.ndarray, "4 4"]
    lights: tuple[TrackedLight, ...]
    regions: tuple[Region, ...]
    residual: Float32[np.ndarray, "n n 3"]
    seen: Float32[np.ndarray, "n n 1"]
