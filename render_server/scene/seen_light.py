"""What any light looks like from a place: direction, size and irradiance across its beam."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from render_server.lights.lights import DirectionalLight, Light, RectangleLight, SphereLight, SpotLight

NEAREST_M = 1e-6


@dataclass(frozen=True, eq=False)
class SeenLight:
    """`toward` is the unit direction to the light (world), `irradiance` falls on a surface that faces it."""

    toward: Float64[np.ndarray, "*n 3"]
    irradiance: Float64[np.ndarray, "*n 3"]
    angular_radius_rad: Float64[np.ndarray, "*n"]


def seen_from(light: Light, place: Float64[np.ndarray, "*n 3"]) -> SeenLight:
    """Return what a light looks like from places (world, m), without anything in between."""
    if isinstance(light, DirectionalLight):
        toward = np.broadcast_to(-light.direction.astype(np.float64), place.shape)
        irradiance = np.broadcast_to(light.irradiance.astype(np.float64), place.shape)
        return SeenLight(toward, irradiance, np.full(place.shape[:-1], light.angular_radius_rad))
    way = light.position.astype(np.float64) - place
    distance = np.maximum(np.linalg.norm(way, axis=-1), NEAREST_M)
    toward = way / distance[..., None]
    if isinstance(light, RectangleLight):
        edges = np.cross(light.axis_u.astype(np.float64), light.axis_v.astype(np.float64))
        shown = np.maximum(-toward @ edges, 0.0)  # area across the line of sight, m^2
        irradiance = light.radiance.astype(np.float64) * (shown / distance**2)[..., None]
        return SeenLight(toward, irradiance, np.arctan(np.sqrt(shown / np.pi) / distance))
    irradiance = light.intensity.astype(np.float64) / distance[..., None] ** 2
    if isinstance(light, SpotLight):
        irradiance = irradiance * _within_cone(light, toward)[..., None]
    return SeenLight(toward, irradiance, _angular_radius(light, distance))


def _within_cone(light: SpotLight, toward: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n"]:
    """Share of a spot's intensity in the direction of whoever looks toward it."""
    angle = np.arccos(np.clip(-toward @ light.direction, -1, 1))
    soft = max(light.half_angle_rad - light.full_angle_rad, 1e-9)
    return np.asarray(np.clip((light.half_angle_rad - angle) / soft, 0, 1))


def _angular_radius(
    light: SphereLight | SpotLight, distance: Float64[np.ndarray, "*n"]
) -> Float64[np.ndarray, "*n"]:
    return np.asarray(np.arcsin(np.minimum(light.radius_m / distance, 1.0)))
