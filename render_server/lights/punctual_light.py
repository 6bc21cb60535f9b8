"""Punctual lights of glTF files (KHR_lights_punctual): points and spots without extent."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from jaxtyping import Float32, Float64

from deltalight.render_server.lights.light_models import Lamp, LightRecord

LEAST_BLEND = 0.001  # between the cosines of a spot's cones, as the extension says


@dataclass(frozen=True, eq=False)
class PunctualLight(Lamp):
    """A point or a spot: E = I cos/d^2, within its range and, of a spot, its cone.

    `intensity` holds on the axis `direction` (unit, world, as light travels). `inner_rad` and `outer_rad` are angles
    from it, None of a point. `range_m` is where the light ends, infinite if nowhere. `radius_m` is 0 but for mirror
    images, which blur widens.
    """

    type = "punctual"
    direction: Float32[np.ndarray, "3"]
    intensity: Float32[np.ndarray, "3"]
    inner_rad: float | None = None
    outer_rad: float | None = None
    range_m: float = math.inf
    radius_m: float = 0.0

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Self:
        """Builds the light from what `describe` made of it."""
        position, direction, intensity = (
            np.asarray(values[key], np.float32) for key in ("position_m", "direction", "intensity")
        )
        inner, outer, range_m = (values[key] for key in ("inner_rad", "outer_rad", "range_m"))
        return cls(position, direction, intensity, inner, outer, range_m or math.inf)

    def describe(self) -> dict[str, Any]:
        """Returns plain values for messages and logs."""
        return {
            "type": self.type,
            "position_m": self.position.tolist(),
            "direction": self.direction.tolist(),
            "intensity": self.intensity.tolist(),
            "inner_rad": self.inner_rad,
            "outer_rad": self.outer_rad,
            "range_m": self.range_m if math.isfinite(self.range_m) else None,
        }

    @property
    def cone(self) -> tuple[Float64[np.ndarray, "3"], float] | None:
        """Axis (unit, as light travels) and half angle, radians, beyond which no light goes; None of a point."""
        return None if self.outer_rad is None else (self.direction.astype(float), self.outer_rad)

    def scaled(self, factor: Float32[np.ndarray, "3"]) -> Self:
        """Returns the light times a factor R G B."""
        return replace(self, intensity=self.intensity * factor)

    def record(self) -> LightRecord:
        """Returns the light as shaders read it."""
        shape = (self.radius_m, *self._falloff)
        return LightRecord(
            4, self.position, self.intensity, shape, self.direction, (1 / self.range_m**2, 0.0, 0.0)
        )

    @property
    def _falloff(self) -> tuple[float, float]:
        """Offset and factor of the angle's cosine that give the root of the fraction of the intensity."""
        if self.inner_rad is None or self.outer_rad is None:
            return 1.0, 0.0
        factor = 1 / max(math.cos(self.inner_rad) - math.cos(self.outer_rad), LEAST_BLEND)
        return -factor * math.cos(self.outer_rad), factor

    def arriving(
        self, to_light: Float64[np.ndarray, "*n 3"], distance: Float64[np.ndarray, "*n"]
    ) -> tuple[Float64[np.ndarray, "*n 3"], Float64[np.ndarray, "*n"]]:
        """Returns the irradiance and the angular radius."""
        offset, factor = self._falloff
        root = np.clip(offset - factor * (to_light @ self.direction.astype(float)), 0, 1)
        window = np.clip(1 - (distance / self.range_m) ** 4, 0, 1)
        fraction = (root**2 * window / distance**2)[..., None]
        return self.intensity.astype(float) * fraction, np.arcsin(np.minimum(self.radius_m / distance, 1.0))

    def image(
        self, position: Float32[np.ndarray, "3"], reflection: Float64[np.ndarray, "3 3"], blur_m: float
    ) -> Self:
        """Returns the mirror image at `position`."""
        direction = np.asarray(reflection @ self.direction, np.float32)
        return replace(
            self, position=position, direction=direction, radius_m=float(np.hypot(self.radius_m, blur_m))
        )

    def placed(self, world_from_node: Float64[np.ndarray, "4 4"]) -> Self:
        """Returns the light at a node's place and along its -z; scale changes neither intensity nor range."""
        axis = -world_from_node[:3, 2]
        return replace(
            self,
            position=world_from_node[:3, 3].astype(np.float32),
            direction=(axis / max(float(np.linalg.norm(axis)), 1e-30)).astype(np.float32),
        )
