"""The lights of a scene as the renderer takes them: a list and a smooth environment around it."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32

from protocol import scene_lights as documents
from protocol.errors import DeltalightError
from render_server.scene.environment import load_environment
from render_server.scene.median_cut import split_environment
from render_server.scene.octahedral import resample_to_octahedral, solid_angle_mean

ENVIRONMENT_SIZE = 256
AMBIENT_SIZE = 16


@dataclass(frozen=True, eq=False)
class DirectionalLight:
    """A distant light: `direction` is the way it travels (unit, world), `irradiance` is across the beam."""

    direction: Float32[np.ndarray, "3"]
    irradiance: Float32[np.ndarray, "3"]
    angular_radius_rad: float

    def scaled(self, factor: Float32[np.ndarray, "3"]) -> "DirectionalLight":
        """Return the light times a factor R G B."""
        return replace(self, irradiance=self.irradiance * factor)

    def describe(self) -> dict[str, Any]:
        """Return plain values for messages and logs."""
        return {
            "type": "directional",
            "direction": self.direction.tolist(),
            "irradiance": self.irradiance.tolist(),
            "angular_radius_deg": float(np.degrees(self.angular_radius_rad)),
        }


@dataclass(frozen=True, eq=False)
class SphereLight:
    """A lamp that shines equally in all directions: E = I cos/d^2; position in metres, world."""

    position: Float32[np.ndarray, "3"]
    intensity: Float32[np.ndarray, "3"]
    radius_m: float

    def scaled(self, factor: Float32[np.ndarray, "3"]) -> "SphereLight":
        """Return the light times a factor R G B."""
        return replace(self, intensity=self.intensity * factor)

    def describe(self) -> dict[str, Any]:
        """Return plain values for messages and logs."""
        return {
            "type": "sphere",
            "position_m": self.position.tolist(),
            "intensity": self.intensity.tolist(),
            "radius_m": self.radius_m,
        }


@dataclass(frozen=True, eq=False)
class LightSet:
    """Everything that shines, in camera units once multiplied by the registration.

    `environment` is the residual radiance map R, octahedral, world axes; the lights are not in it.
    `registration` is the factor R G B that `lights` and `environment` still lack; where `registration_auto`
    is set it is to be found from the picture first.
    """

    lights: tuple[DirectionalLight | SphereLight, ...]
    environment: Float32[np.ndarray, "n n 3"]
    registration: Float32[np.ndarray, "3"]
    registration_auto: bool

    def registered(self, factor: Float32[np.ndarray, "3"] | None = None) -> "LightSet":
        """Return the set with the registration (or another factor) multiplied in."""
        chosen = np.asarray(self.registration if factor is None else factor, np.float32)
        return LightSet(
            tuple(light.scaled(chosen) for light in self.lights),
            self.environment * chosen,
            np.ones(3, np.float32),
            False,
        )

    def describe(self) -> list[dict[str, Any]]:
        """Return plain values of all lights and of the environment's mean, for messages and logs."""
        ambient = {"type": "environment", "mean_radiance": solid_angle_mean(self.environment).tolist()}
        return [*(light.describe() for light in self.lights), ambient]


def build_lights(lights: documents.Lights) -> LightSet:
    """Make the light set of a scene document's `lights`.

    Modes `manual` (directional, sphere, ambient) and `environment`; the latter is split with the count and
    the kind of split that `lights.fisheye` gives, as in mode `fisheye`.

    Raises:
        DeltalightError: a mode or light that this release lacks, or an environment map that cannot be read.
    """
    if lights.mode == "manual":
        shining, environment = _manual(lights.manual)
    elif lights.mode == "environment":
        shining, environment = _from_environment(lights)
    else:
        raise DeltalightError(
            f"lights of mode {lights.mode} arrive with a later release; use mode manual or environment."
        )
    given = lights.resolved_registration
    auto = given == "auto"
    factor = np.ones(3, np.float32) if auto else np.array(given, np.float32)
    return LightSet(shining, environment, factor, auto)


def _manual(
    manual: tuple[documents.ManualLight, ...],
) -> tuple[tuple[DirectionalLight | SphereLight, ...], Float32[np.ndarray, "n n 3"]]:
    shining = tuple(_light(light) for light in manual if not isinstance(light, documents.AmbientLight))
    ambient = np.zeros(3, np.float32)
    for light in manual:
        if isinstance(light, documents.AmbientLight):
            ambient += np.float32(light.radiance) * np.array(light.color_linear, np.float32)
    return shining, np.tile(ambient, (AMBIENT_SIZE, AMBIENT_SIZE, 1))


def _light(light: documents.ManualLight) -> DirectionalLight | SphereLight:
    color = np.array(light.color_linear, np.float32)
    if isinstance(light, documents.DirectionalLight):
        direction = np.array(light.direction, np.float32)
        radius = float(np.radians(light.angular_radius_deg))
        return DirectionalLight(direction, light.irradiance * color, radius)
    if isinstance(light, documents.SphereLight):
        position = np.array(light.position_m, np.float32)
        return SphereLight(position, light.intensity * color, light.radius_m)
    raise DeltalightError(
        f"lights of type {light.type} arrive with a later release; use sphere, directional or ambient."
    )


def _from_environment(
    lights: documents.Lights,
) -> tuple[tuple[DirectionalLight | SphereLight, ...], Float32[np.ndarray, "n n 3"]]:
    whole_map = lights.fisheye.split == "all"
    split = split_environment(load_environment(lights.environment), lights.fisheye.count, whole_map=whole_map)
    shining = tuple(
        DirectionalLight(
            (-light.toward).astype(np.float32), light.irradiance.astype(np.float32), light.angular_radius_rad
        )
        for light in split.lights
    )
    return shining, resample_to_octahedral(split.residual.sample, ENVIRONMENT_SIZE)
