"""Lights of a scene as the renderer uses them: light models and a smooth environment around them."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol import scene_lights as documents
from deltalight.protocol.octahedral import resample_to_octahedral
from deltalight.render_server.lights.environment import load_environment, split_environment
from deltalight.render_server.lights.light_models import LIGHT_TYPES, DirectionalLight, Light
from deltalight.render_server.lights.octahedral import above_horizon, solid_angle_mean

ENVIRONMENT_SIZE = 256
AMBIENT_SIZE = 64  # texels of 1.5 to 5 degrees: a metal of roughness 0.3 still resolves the edge of a wall


@dataclass(frozen=True, eq=False)
class LightSet:
    """Everything that shines, in camera units once multiplied by the registration.

    `environment` is the residual radiance map R without the lights, octahedral, world axes. `ground_fraction` (0..1)
    is the fraction of each of its texels that shows the real ground, because nothing else is known to be there.
    `registration` is the factor R G B that `lights` and `environment` still lack, ones where it is to be estimated
    from the picture. `identities` number the lights where they are tracked over time. `whole` is the map that the
    lights were cut out of, where it is given. `environment_origin` is where the environment was measured (world, m);
    None where that is unknown.
    """

    lights: tuple[Light, ...]
    environment: Float32[np.ndarray, "n n 3"]
    ground_fraction: Float32[np.ndarray, "n n 1"]
    registration: Float32[np.ndarray, "3"]
    identities: tuple[int, ...] = ()
    whole: Float32[np.ndarray, "n n 3"] | None = None
    environment_origin: Float64[np.ndarray, "3"] | None = None

    def registered(self, factor: Float32[np.ndarray, "3"] | None = None) -> "LightSet":
        """Returns the set with the registration (or another factor) multiplied in."""
        chosen = np.asarray(self.registration if factor is None else factor, np.float32)
        return replace(
            self,
            lights=tuple(light.scaled(chosen) for light in self.lights),
            environment=self.environment * chosen,
            registration=np.ones(3, np.float32),
            whole=None if self.whole is None else self.whole * chosen,
        )

    def with_ground(self, radiance: Float32[np.ndarray, "3"]) -> "LightSet":
        """Returns the set with ground of this radiance in `ground_fraction` of its environment."""
        ground = np.broadcast_to(radiance, self.environment.shape)
        return self.with_surfaces(ground, self.ground_fraction)

    def with_surfaces(
        self, radiance: Float32[np.ndarray, "n n 3"], fraction: Float32[np.ndarray, "n n 1"]
    ) -> "LightSet":
        """Returns the set with surfaces (maps of the environment's size) in front of a fraction of each texel."""
        return replace(self, environment=(1 - fraction) * self.environment + fraction * radiance)

    def with_sky(self, radiance: Float32[np.ndarray, "3"], shape: Float32[np.ndarray, "n n 1"]) -> "LightSet":
        """Returns the set with radiance added above the horizon, times `shape` (of the environment's size)."""
        above = above_horizon(len(self.environment))
        return replace(self, environment=self.environment + above * shape * radiance)

    def describe(self) -> list[dict[str, Any]]:
        """Returns plain values of all lights and of the environment's mean, for messages and logs."""
        lights = [light.describe() for light in self.lights]
        for light, identity in zip(lights, self.identities, strict=False):
            light["id"] = identity
        return [
            *lights,
            {"type": "environment", "mean_radiance": self._mean_radiance.tolist()},
        ]

    @cached_property
    def _mean_radiance(self) -> Float64[np.ndarray, "3"]:
        return solid_angle_mean(self.environment)


def build_lights(lights: documents.Lights) -> LightSet:
    """Builds the light set of a scene document in mode `manual` or `environment`.

    An environment is split by the settings of `lights.fisheye`, as in mode `fisheye`.

    Raises:
        DeltalightError: an environment map that cannot be read.
    """
    if lights.mode == "environment":
        return _from_environment(lights)
    shining, environment = _manual(lights.manual)
    return light_set(lights, shining, environment, 1 - above_horizon(len(environment)))


def light_set(
    lights: documents.Lights,
    shining: tuple[Light, ...],
    environment: Float32[np.ndarray, "n n 3"],
    ground_fraction: Float32[np.ndarray, "n n 1"],
    identities: tuple[int, ...] = (),
) -> LightSet:
    """Assembles a light set with the registration that a scene document requests."""
    given = lights.resolved_registration
    factor = np.ones(3, np.float32) if given == "auto" else np.array(given, np.float32)
    return LightSet(shining, environment, ground_fraction, factor, identities)


def _manual(
    manual: tuple[documents.ManualLight, ...],
) -> tuple[tuple[Light, ...], Float32[np.ndarray, "n n 3"]]:
    shining = tuple(
        LIGHT_TYPES[light.type].from_values(light.model_dump())
        for light in manual
        if not isinstance(light, documents.AmbientLight)
    )
    ambient = np.zeros(3, np.float32)
    for light in manual:
        if isinstance(light, documents.AmbientLight):
            ambient += np.float32(light.radiance) * np.array(light.color_linear, np.float32)
    return shining, np.tile(ambient, (AMBIENT_SIZE, AMBIENT_SIZE, 1))


def _from_environment(lights: documents.Lights) -> LightSet:
    settings, environment = lights.fisheye, load_environment(lights.environment)
    split = split_environment(
        environment, settings.count, threshold=settings.threshold, whole_map=settings.split == "all"
    )
    shining = tuple(
        DirectionalLight(
            (-light.to_light).astype(np.float32),
            light.irradiance.astype(np.float32),
            light.angular_radius_rad,
        )
        for light in split.lights
    )
    residual, whole = (
        resample_to_octahedral(each.sample, ENVIRONMENT_SIZE) for each in (split.residual, environment)
    )
    return replace(light_set(lights, shining, residual, 1 - above_horizon(ENVIRONMENT_SIZE)), whole=whole)
