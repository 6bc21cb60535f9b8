"""What any light looks like from a place: direction, size and irradiance across its beam."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from render_server.scene.lights import DirectionalLight, Light, RectangleLight, SphereLight, SpotLight


@dataclass(frozen=True, eq=False)
class SeenLight:
    """`toward` is the unit direction to the light (world), `irradiance` falls on a surface that faces it."""

    toward: Float64[np.ndarray, "3"]
    irradiance: Float64[np.ndarray, "3"]
    angular_radius_rad: float


def seen_from(light: Light, place: Float64[np.ndarray, "3"]) -> SeenLight:
    """Return what a light looks like from a place (world, m), without anything in between."""
    if isinstance(light, DirectionalLight):
        toward = -light.direction.astype(np.float64)
        return SeenLight(toward, light.irradiance.astype(np.float64), light.angular_radius_rad)
    way = light.position.astype(np.float64) - place
    distance = max(float(np.linalg.norm(way)), 1e-6)
    toward = way / distance
    if isinstance(light, RectangleLight):
        edges = np.cross(light.axis_u.astype(np.float64), light.axis_v.astype(np.float64))
        shown = max(float(-toward @ edges), 0.0)  # area across the line of sight, m^2
        irradiance = light.radiance.astype(np.float64) * shown / distance**2
        return SeenLight(toward, irradiance, float(np.arctan(np.sqrt(shown / np.pi) / distance)))
    irradiance = light.intensity.astype(np.float64) / distance**2
    if isinstance(light, SpotLight):
        irradiance = irradiance * _within_cone(light, toward)
    return SeenLight(toward, irradiance, _angular_radius(light, distance))


def _within_cone(light: SpotLight, toward: Float64[np.ndarray, "3"]) -> float:
    """Share of a spot's intensity in the direction of whoever looks toward it."""
    angle = float(np.arccos(np.clip(-toward @ light.direction, -1, 1)))
    soft = max(light.half_angle_rad - light.full_angle_rad, 1e-9)
    return float(np.clip((light.half_angle_rad - angle) / soft, 0, 1))


def _angular_radius(light: SphereLight | SpotLight, distance: float) -> float:
    return float(np.arcsin(min(light.radius_m / distance, 1.0)))
