"""Lights of a benchmark scene, each as Mitsuba's emitter and in the scene document (docs/formats.md 3)."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float64

from deltalight.benchmarks.ground_truth.parts import Triple, placed, rgb, shape

WHITE: Triple = (1.0, 1.0, 1.0)


class Lamp(Protocol):
    """A light in both representations."""

    def mitsuba(self) -> dict[str, Any]:
        """Returns the emitter, or the shape that carries it."""
        ...

    def document(self) -> dict[str, Any]:
        """Returns the entry of `lights.manual`."""
        ...


@dataclass(frozen=True)
class SphereLamp:
    """Uniform sphere; `intensity` in camera units times square metres (E = intensity cos / distance^2)."""

    position_m: Triple
    intensity: float
    radius_m: float
    color_linear: Triple = WHITE

    def mitsuba(self) -> dict[str, Any]:
        """Returns an emitting sphere: intensity = radiance times the area of its disc."""
        radiance = np.array(self.color_linear) * self.intensity / (np.pi * self.radius_m**2)
        place = placed(self.position_m, scale=(self.radius_m,) * 3)
        return shape("sphere", place, emitter={"type": "area", "radiance": rgb(radiance)})

    def document(self) -> dict[str, Any]:
        """Returns it as a sphere light."""
        return {
            "type": "sphere",
            "position_m": list(self.position_m),
            "intensity": self.intensity,
            "radius_m": self.radius_m,
            "color_linear": list(self.color_linear),
        }


@dataclass(frozen=True)
class Ambient:
    """The same radiance from every direction."""

    radiance: float
    color_linear: Triple = WHITE

    def mitsuba(self) -> dict[str, Any]:
        """Returns a constant environment."""
        return {"type": "constant", "radiance": rgb(np.array(self.color_linear) * self.radiance)}

    def document(self) -> dict[str, Any]:
        """Returns it as an ambient light."""
        return {"type": "ambient", "radiance": self.radiance, "color_linear": list(self.color_linear)}


@dataclass(frozen=True)
class Spot:
    """Lamp with a cone: constant within the inner part of the half angle, then falling linearly in angle to zero.

    `angle_deg` is the full opening angle, `blend` the fraction of the half angle in which the light falls. Mitsuba's
    spot is a point; the document gives it a radius of 0, and cameras see it only through `point_lamps`.
    """

    position_m: Triple
    direction: Triple
    intensity: float
    angle_deg: float
    blend: float
    color_linear: Triple = WHITE

    def mitsuba(self) -> dict[str, Any]:
        """Returns a spot emitter."""
        import mitsuba as mi

        target = [float(v) for v in np.add(self.position_m, self.direction)]
        up = (
            [1.0, 0.0, 0.0]
            if abs(self.direction[2]) > 0.9 * float(np.linalg.norm(self.direction))
            else [0.0, 0.0, 1.0]
        )
        half = self.angle_deg / 2
        return {
            "type": "spot",
            "to_world": mi.ScalarTransform4f().look_at(origin=list(self.position_m), target=target, up=up),
            "intensity": rgb(np.array(self.color_linear) * self.intensity),
            "cutoff_angle": half,
            "beam_width": half * (1 - self.blend),
        }

    def irradiance(self, point: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
        """Returns the unshadowed irradiance across the beam at a point, linear R G B."""
        offset = point - np.array(self.position_m)
        squared = float(offset @ offset)
        axis = np.array(self.direction) / np.linalg.norm(self.direction)
        angle = float(np.degrees(np.arccos(np.clip(offset @ axis / np.sqrt(squared), -1, 1))))
        half = self.angle_deg / 2
        fraction = np.clip((half - angle) / (half * self.blend), 0, 1)
        return np.asarray(np.array(self.color_linear) * self.intensity * fraction / squared)

    def document(self) -> dict[str, Any]:
        """Returns it as a spot light."""
        return {
            "type": "spot",
            "position_m": list(self.position_m),
            "direction": list(self.direction),
            "intensity": self.intensity,
            "angle_deg": self.angle_deg,
            "blend": self.blend,
            "radius_m": 0.0,
            "color_linear": list(self.color_linear),
        }


@dataclass(frozen=True)
class Panel:
    """Emitting rectangle around `center_m`; its edges are whole lengths and it shines towards edge_u x edge_v."""

    center_m: Triple
    edge_u_m: Triple
    edge_v_m: Triple
    radiance: float
    color_linear: Triple = WHITE

    def mitsuba(self) -> dict[str, Any]:
        """Returns a rectangle whose z axis is edge_u x edge_v."""
        u, v = np.array(self.edge_u_m), np.array(self.edge_v_m)
        normal = np.cross(u, v)
        place = np.eye(4)
        place[:3] = np.stack([u / 2, v / 2, normal / np.linalg.norm(normal), self.center_m], axis=1)
        radiance = np.array(self.color_linear) * self.radiance
        return shape("rectangle", place, emitter={"type": "area", "radiance": rgb(radiance)})

    def document(self) -> dict[str, Any]:
        """Returns it as a rectangle light; its centre is its position (docs/formats.md 3)."""
        return {
            "type": "rectangle",
            "position_m": list(self.center_m),
            "axis_u_m": list(self.edge_u_m),
            "axis_v_m": list(self.edge_v_m),
            "radiance": self.radiance,
            "color_linear": list(self.color_linear),
        }
