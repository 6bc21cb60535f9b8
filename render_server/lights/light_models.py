"""Light models: what each type of light shines where, its mirror image, and its record for shaders."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from jaxtyping import Float32, Float64

MIN_DISTANCE_M = 1e-6
NARROWEST_BLEND_RAD = 1e-4  # what a spot without blend falls off over on the GPU

Plane = Float64[np.ndarray, "4"]
Axis = Float32[np.ndarray, "3"] | tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class LightRecord:
    """A light as `Light` of shaders/common/light_shapes.glsl holds it, whose kinds `kind` counts."""

    kind: int
    place: Float32[np.ndarray, "3"]
    color: Float32[np.ndarray, "3"]
    shape: tuple[float, float, float]
    axis_u: Axis = (0.0, 0.0, 0.0)
    axis_v: Axis = (0.0, 0.0, 0.0)


class LightModel(ABC):
    """What every type of light can do; `type` is its name in the scene document."""

    type: ClassVar[str]

    @classmethod
    @abstractmethod
    def from_values(cls, values: Mapping[str, Any]) -> Self:
        """Builds the light from the keys of its scene document, or from what `describe` made of it."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Returns plain values for messages and logs."""

    @abstractmethod
    def scaled(self, factor: Float32[np.ndarray, "3"]) -> Self:
        """Returns the light times a factor R G B."""

    @abstractmethod
    def record(self) -> LightRecord:
        """Returns the light as shaders read it."""


@dataclass(frozen=True, eq=False)
class DirectionalLight(LightModel):
    """A distant light: `direction` of travel (unit, world), `irradiance` across the beam."""

    type = "directional"
    direction: Float32[np.ndarray, "3"]
    irradiance: Float32[np.ndarray, "3"]
    angular_radius_rad: float

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Self:
        """Builds the light from the keys of its scene document, or from what `describe` made of it."""
        radius = float(np.radians(values["angular_radius_deg"]))
        return cls(_vector(values["direction"]), _strength(values, "irradiance"), radius)

    def describe(self) -> dict[str, Any]:
        """Returns plain values for messages and logs."""
        return {
            "type": self.type,
            "direction": self.direction.tolist(),
            "irradiance": self.irradiance.tolist(),
            "angular_radius_deg": float(np.degrees(self.angular_radius_rad)),
        }

    def scaled(self, factor: Float32[np.ndarray, "3"]) -> Self:
        """Returns the light times a factor R G B."""
        return replace(self, irradiance=self.irradiance * factor)

    def record(self) -> LightRecord:
        """Returns the light as shaders read it."""
        return LightRecord(0, self.direction, self.irradiance, (math.tan(self.angular_radius_rad), 1.0, 0.0))


@dataclass(frozen=True, eq=False)
class Lamp(LightModel):
    """A light at a place: `position` in metres, world."""

    position: Float32[np.ndarray, "3"]

    @property
    def front(self) -> Plane | None:
        """Plane a, b, c, d (world) through the lamp: it shines where ax + by + cz + d > 0; None: to all sides."""
        return None

    @property
    def cone(self) -> tuple[Float64[np.ndarray, "3"], float] | None:
        """Axis (unit, as light travels) and half angle, radians, beyond which no light goes; None: no such cone."""
        return None

    @abstractmethod
    def arriving(
        self, to_light: Float64[np.ndarray, "*n 3"], distance: Float64[np.ndarray, "*n"]
    ) -> tuple[Float64[np.ndarray, "*n 3"], Float64[np.ndarray, "*n"]]:
        """Returns the irradiance on a surface that faces the lamp, and its angular radius.

        `to_light` are the unit directions towards it, `distance` is in metres.
        """

    @abstractmethod
    def image(
        self, position: Float32[np.ndarray, "3"], reflection: Float64[np.ndarray, "3 3"], blur_m: float
    ) -> Self:
        """Returns the mirror image at `position`: directions go through `reflection`, extents grow by the blur."""


@dataclass(frozen=True, eq=False)
class SphereLight(Lamp):
    """An isotropic lamp: E = I cos/d^2."""

    type = "sphere"
    intensity: Float32[np.ndarray, "3"]
    radius_m: float

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Self:
        """Builds the light from the keys of its scene document, or from what `describe` made of it."""
        return cls(_vector(values["position_m"]), _strength(values, "intensity"), float(values["radius_m"]))

    def describe(self) -> dict[str, Any]:
        """Returns plain values for messages and logs."""
        return {
            "type": self.type,
            "position_m": self.position.tolist(),
            "intensity": self.intensity.tolist(),
            "radius_m": self.radius_m,
        }

    def scaled(self, factor: Float32[np.ndarray, "3"]) -> Self:
        """Returns the light times a factor R G B."""
        return replace(self, intensity=self.intensity * factor)

    def record(self) -> LightRecord:
        """Returns the light as shaders read it."""
        return LightRecord(1, self.position, self.intensity, (self.radius_m, 1.0, 0.0))

    def arriving(
        self, to_light: Float64[np.ndarray, "*n 3"], distance: Float64[np.ndarray, "*n"]
    ) -> tuple[Float64[np.ndarray, "*n 3"], Float64[np.ndarray, "*n"]]:
        """Returns the irradiance and the angular radius."""
        del to_light
        return _inverse_square(self.intensity, distance), _angular_radius(self.radius_m, distance)

    def image(
        self, position: Float32[np.ndarray, "3"], reflection: Float64[np.ndarray, "3 3"], blur_m: float
    ) -> Self:
        """Returns the mirror image at `position`."""
        del reflection
        return replace(self, position=position, radius_m=float(np.hypot(self.radius_m, blur_m)))


@dataclass(frozen=True, eq=False)
class SpotLight(Lamp):
    """A lamp whose intensity is constant up to an angle from its axis, then falls to zero linearly in the angle.

    `direction` (unit, world) is the axis as light travels, `intensity` holds on it.
    """

    type = "spot"
    direction: Float32[np.ndarray, "3"]
    intensity: Float32[np.ndarray, "3"]
    radius_m: float
    half_angle_rad: float
    blend: float

    @property
    def full_angle_rad(self) -> float:
        """Angle from the axis up to which the intensity is constant."""
        return self.half_angle_rad * (1.0 - self.blend)

    @property
    def cone(self) -> tuple[Float64[np.ndarray, "3"], float]:
        """Axis (unit, as light travels) and half angle, radians, beyond which no light goes."""
        return self.direction.astype(float), self.half_angle_rad

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Self:
        """Builds the light from the keys of its scene document, or from what `describe` made of it."""
        return cls(
            _vector(values["position_m"]),
            _vector(values["direction"]),
            _strength(values, "intensity"),
            float(values["radius_m"]),
            float(np.radians(values["angle_deg"] / 2)),
            float(values["blend"]),
        )

    def describe(self) -> dict[str, Any]:
        """Returns plain values for messages and logs."""
        return {
            "type": self.type,
            "position_m": self.position.tolist(),
            "direction": self.direction.tolist(),
            "intensity": self.intensity.tolist(),
            "radius_m": self.radius_m,
            "angle_deg": float(np.degrees(2 * self.half_angle_rad)),
            "blend": self.blend,
        }

    def scaled(self, factor: Float32[np.ndarray, "3"]) -> Self:
        """Returns the light times a factor R G B."""
        return replace(self, intensity=self.intensity * factor)

    def record(self) -> LightRecord:
        """Returns the light as shaders read it."""
        blend = max(self.half_angle_rad - self.full_angle_rad, NARROWEST_BLEND_RAD)
        shape = (self.radius_m, self.half_angle_rad / blend, 1.0 / blend)
        return LightRecord(2, self.position, self.intensity, shape, self.direction)

    def arriving(
        self, to_light: Float64[np.ndarray, "*n 3"], distance: Float64[np.ndarray, "*n"]
    ) -> tuple[Float64[np.ndarray, "*n 3"], Float64[np.ndarray, "*n"]]:
        """Returns the irradiance and the angular radius."""
        irradiance = _inverse_square(self.intensity, distance) * self._emitted(to_light)[..., None]
        return irradiance, _angular_radius(self.radius_m, distance)

    def _emitted(self, to_light: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n"]:
        """Returns the fraction of the intensity that goes against `to_light`."""
        angle = np.arccos(np.clip(-to_light @ self.direction, -1, 1))
        soft = max(self.half_angle_rad - self.full_angle_rad, 1e-9)
        return np.asarray(np.clip((self.half_angle_rad - angle) / soft, 0, 1))

    def image(
        self, position: Float32[np.ndarray, "3"], reflection: Float64[np.ndarray, "3 3"], blur_m: float
    ) -> Self:
        """Returns the mirror image at `position`."""
        radius = float(np.hypot(self.radius_m, blur_m))
        return replace(
            self, position=position, direction=_vector(reflection @ self.direction), radius_m=radius
        )


@dataclass(frozen=True, eq=False)
class RectangleLight(Lamp):
    """A diffuse parallelogram around `position` that shines with `radiance` to the side of axis_u x axis_v.

    The axes are whole edges; metres, world.
    """

    type = "rectangle"
    axis_u: Float32[np.ndarray, "3"]
    axis_v: Float32[np.ndarray, "3"]
    radiance: Float32[np.ndarray, "3"]

    @property
    def normal(self) -> Float64[np.ndarray, "3"]:
        """Unit normal of the shining side."""
        across = np.cross(self.axis_u.astype(float), self.axis_v.astype(float))
        return np.asarray(across / np.linalg.norm(across))

    @property
    def front(self) -> Plane:
        """The rectangle's own plane."""
        normal = self.normal
        return np.append(normal, -normal @ self.position.astype(float))

    @classmethod
    def from_values(cls, values: Mapping[str, Any]) -> Self:
        """Builds the light from the keys of its scene document, or from what `describe` made of it."""
        axes = _vector(values["axis_u_m"]), _vector(values["axis_v_m"])
        return cls(_vector(values["position_m"]), *axes, _strength(values, "radiance"))

    def describe(self) -> dict[str, Any]:
        """Returns plain values for messages and logs."""
        return {
            "type": self.type,
            "position_m": self.position.tolist(),
            "axis_u_m": self.axis_u.tolist(),
            "axis_v_m": self.axis_v.tolist(),
            "radiance": self.radiance.tolist(),
        }

    def scaled(self, factor: Float32[np.ndarray, "3"]) -> Self:
        """Returns the light times a factor R G B."""
        return replace(self, radiance=self.radiance * factor)

    def record(self) -> LightRecord:
        """Returns the light as shaders read it."""
        shape = (0.0, 1.0, 0.0)
        return LightRecord(3, self.position, self.radiance, shape, self.axis_u / 2, self.axis_v / 2)

    def arriving(
        self, to_light: Float64[np.ndarray, "*n 3"], distance: Float64[np.ndarray, "*n"]
    ) -> tuple[Float64[np.ndarray, "*n 3"], Float64[np.ndarray, "*n"]]:
        """Returns the irradiance and the angular radius."""
        edges = np.cross(self.axis_u.astype(np.float64), self.axis_v.astype(np.float64))
        shown = np.maximum(-to_light @ edges, 0.0)  # area across the line of sight, m^2
        irradiance = self.radiance.astype(np.float64) * (shown / distance**2)[..., None]
        return irradiance, np.arctan(np.sqrt(shown / np.pi) / distance)

    def image(
        self, position: Float32[np.ndarray, "3"], reflection: Float64[np.ndarray, "3 3"], blur_m: float
    ) -> Self:
        """Returns the mirror image at `position`: the axes change places to keep the orientation, and blur widens it
        at the same flux.
        """
        u, v = (float(np.linalg.norm(axis)) for axis in (self.axis_u, self.axis_v))
        grown = [float(np.hypot(edge, 2 * blur_m) / edge) for edge in (u, v)]
        return replace(
            self,
            position=position,
            axis_u=_vector(reflection @ self.axis_v * grown[1]),
            axis_v=_vector(reflection @ self.axis_u * grown[0]),
            radiance=self.radiance / np.float32(grown[0] * grown[1]),
        )


Light = DirectionalLight | Lamp
LIGHT_TYPES: Mapping[str, type[Light]] = {
    light.type: light for light in (DirectionalLight, SphereLight, SpotLight, RectangleLight)
}


@dataclass(frozen=True, eq=False)
class IncidentLight:
    """Light as it arrives at positions: unit direction to it (world), irradiance on a surface that faces it."""

    to_light: Float64[np.ndarray, "*n 3"]
    irradiance: Float64[np.ndarray, "*n 3"]
    angular_radius_rad: Float64[np.ndarray, "*n"]


def incident_light(light: Light, position: Float64[np.ndarray, "*n 3"]) -> IncidentLight:
    """Returns the unoccluded light at positions (world, m)."""
    if isinstance(light, DirectionalLight):
        to_light = np.broadcast_to(-light.direction.astype(np.float64), position.shape)
        irradiance = np.broadcast_to(light.irradiance.astype(np.float64), position.shape)
        return IncidentLight(to_light, irradiance, np.full(position.shape[:-1], light.angular_radius_rad))
    offset = light.position.astype(np.float64) - position
    distance = np.maximum(np.linalg.norm(offset, axis=-1), MIN_DISTANCE_M)
    to_light = offset / distance[..., None]
    return IncidentLight(to_light, *light.arriving(to_light, distance))


def _inverse_square(
    intensity: Float32[np.ndarray, "3"], distance: Float64[np.ndarray, "*n"]
) -> Float64[np.ndarray, "*n 3"]:
    return np.asarray(intensity.astype(np.float64) / distance[..., None] ** 2)


def _angular_radius(radius_m: float, distance: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    return np.asarray(np.arcsin(np.minimum(radius_m / distance, 1.0)))


def _vector(values: Sequence[float] | np.ndarray) -> Float32[np.ndarray, "3"]:
    return np.asarray(values, np.float32)


def _strength(values: Mapping[str, Any], key: str) -> Float32[np.ndarray, "3"]:
    """R G B: one strength times the colour, or given as such."""
    color = _vector(values.get("color_linear", (1.0, 1.0, 1.0)))
    return np.asarray(np.asarray(values[key], np.float32) * color)
