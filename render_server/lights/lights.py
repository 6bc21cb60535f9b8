"""The lights of a scene as the renderer takes them: a list and a smooth environment around it."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from protocol import scene_lights as documents
from render_server.lights.environment import load_environment
from render_server.lights.median_cut import split_environment
from render_server.lights.octahedral import above_horizon, resample_to_octahedral, solid_angle_mean

ENVIRONMENT_SIZE = 256
AMBIENT_SIZE = 64  # texels of 1.5 to 5 degrees: what a metal of roughness 0.3 still shows of a wall's edge


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
class SpotLight:
    """A lamp whose intensity is constant up to an angle from its axis, then falls to zero linearly in the angle.

    `direction` (unit, world) is the axis as light travels, `intensity` holds on it; position in metres, world.
    """

    position: Float32[np.ndarray, "3"]
    direction: Float32[np.ndarray, "3"]
    intensity: Float32[np.ndarray, "3"]
    radius_m: float
    half_angle_rad: float
    blend: float

    @property
    def full_angle_rad(self) -> float:
        """Angle from the axis up to which the intensity is constant."""
        return self.half_angle_rad * (1.0 - self.blend)

    def scaled(self, factor: Float32[np.ndarray, "3"]) -> "SpotLight":
        """Return the light times a factor R G B."""
        return replace(self, intensity=self.intensity * factor)

    def describe(self) -> dict[str, Any]:
        """Return plain values for messages and logs."""
        return {
            "type": "spot",
            "position_m": self.position.tolist(),
            "direction": self.direction.tolist(),
            "intensity": self.intensity.tolist(),
            "radius_m": self.radius_m,
            "angle_deg": float(np.degrees(2 * self.half_angle_rad)),
            "blend": self.blend,
        }


@dataclass(frozen=True, eq=False)
class RectangleLight:
    """A diffuse parallelogram around `position` that shines with `radiance` to the side of axis_u x axis_v.

    The axes are whole edges; metres, world.
    """

    position: Float32[np.ndarray, "3"]
    axis_u: Float32[np.ndarray, "3"]
    axis_v: Float32[np.ndarray, "3"]
    radiance: Float32[np.ndarray, "3"]

    @property
    def normal(self) -> Float64[np.ndarray, "3"]:
        """Unit normal of the shining side."""
        across = np.cross(self.axis_u.astype(float), self.axis_v.astype(float))
        return np.asarray(across / np.linalg.norm(across))

    def scaled(self, factor: Float32[np.ndarray, "3"]) -> "RectangleLight":
        """Return the light times a factor R G B."""
        return replace(self, radiance=self.radiance * factor)

    def describe(self) -> dict[str, Any]:
        """Return plain values for messages and logs."""
        return {
            "type": "rectangle",
            "position_m": self.position.tolist(),
            "axis_u_m": self.axis_u.tolist(),
            "axis_v_m": self.axis_v.tolist(),
            "radiance": self.radiance.tolist(),
        }


Light = DirectionalLight | SphereLight | SpotLight | RectangleLight


@dataclass(frozen=True, eq=False)
class LightSet:
    """Everything that shines, in camera units once multiplied by the registration.

    `environment` is the residual radiance map R, octahedral, world axes; the lights are not in it. Of it,
    `ground_share` (0..1) is the share of each texel where the real ground's radiance belongs, because nothing else
    is known to be there. `registration` is the factor R G B that `lights` and `environment` still lack, ones where
    it is to be found from the picture first. `identities` number the lights where they are followed over time.
    """

    lights: tuple[Light, ...]
    environment: Float32[np.ndarray, "n n 3"]
    ground_share: Float32[np.ndarray, "n n 1"]
    registration: Float32[np.ndarray, "3"]
    identities: tuple[int, ...] = ()

    def registered(self, factor: Float32[np.ndarray, "3"] | None = None) -> "LightSet":
        """Return the set with the registration (or another factor) multiplied in."""
        chosen = np.asarray(self.registration if factor is None else factor, np.float32)
        return replace(
            self,
            lights=tuple(light.scaled(chosen) for light in self.lights),
            environment=self.environment * chosen,
            registration=np.ones(3, np.float32),
        )

    def with_ground(self, radiance: Float32[np.ndarray, "3"]) -> "LightSet":
        """Return the set with ground of this radiance below the horizon, where nothing else is known to be."""
        ground = np.broadcast_to(radiance, self.environment.shape)
        return self.with_surfaces(ground, self.ground_share)

    def with_surfaces(
        self, radiance: Float32[np.ndarray, "n n 3"], share: Float32[np.ndarray, "n n 1"]
    ) -> "LightSet":
        """Return the set with surfaces (maps of the environment's size) before a share of each direction."""
        return replace(self, environment=(1 - share) * self.environment + share * radiance)

    def with_sky(self, radiance: Float32[np.ndarray, "3"], shape: Float32[np.ndarray, "n n 1"]) -> "LightSet":
        """Return the set with more radiance above the horizon: `shape` (of the environment's size) times this."""
        above = above_horizon(len(self.environment))
        return replace(self, environment=self.environment + above * shape * radiance)

    def describe(self) -> list[dict[str, Any]]:
        """Return plain values of all lights and of the environment's mean, for messages and logs."""
        lights = [light.describe() for light in self.lights]
        for light, identity in zip(lights, self.identities, strict=False):
            light["id"] = identity
        return [
            *lights,
            {"type": "environment", "mean_radiance": solid_angle_mean(self.environment).tolist()},
        ]


def build_lights(lights: documents.Lights) -> LightSet:
    """Make the light set of a scene document whose lights are given: modes `manual` and `environment`.

    An environment is split with the count, the threshold and the kind of split that `lights.fisheye` gives, as in
    mode `fisheye`.

    Raises:
        DeltalightError: an environment map that cannot be read.
    """
    shining, environment = (
        _from_environment(lights) if lights.mode == "environment" else _manual(lights.manual)
    )
    return complete_set(lights, shining, environment, 1 - above_horizon(len(environment)))


def complete_set(
    lights: documents.Lights,
    shining: tuple[Light, ...],
    environment: Float32[np.ndarray, "n n 3"],
    ground_share: Float32[np.ndarray, "n n 1"],
    identities: tuple[int, ...] = (),
) -> LightSet:
    """Add the registration that a scene document wishes."""
    given = lights.resolved_registration
    factor = np.ones(3, np.float32) if given == "auto" else np.array(given, np.float32)
    return LightSet(shining, environment, ground_share, factor, identities)


def _manual(
    manual: tuple[documents.ManualLight, ...],
) -> tuple[tuple[Light, ...], Float32[np.ndarray, "n n 3"]]:
    shining = tuple(_light(light) for light in manual if not isinstance(light, documents.AmbientLight))
    ambient = np.zeros(3, np.float32)
    for light in manual:
        if isinstance(light, documents.AmbientLight):
            ambient += np.float32(light.radiance) * np.array(light.color_linear, np.float32)
    return shining, np.tile(ambient, (AMBIENT_SIZE, AMBIENT_SIZE, 1))


_Shining = documents.DirectionalLight | documents.SphereLight | documents.SpotLight | documents.RectangleLight


def _light(light: _Shining) -> Light:
    color = np.array(light.color_linear, np.float32)
    if isinstance(light, documents.DirectionalLight):
        direction = np.array(light.direction, np.float32)
        radius = float(np.radians(light.angular_radius_deg))
        return DirectionalLight(direction, light.irradiance * color, radius)
    position = np.array(light.position_m, np.float32)
    if isinstance(light, documents.SphereLight):
        return SphereLight(position, light.intensity * color, light.radius_m)
    if isinstance(light, documents.SpotLight):
        direction, half = np.array(light.direction, np.float32), float(np.radians(light.angle_deg / 2))
        return SpotLight(position, direction, light.intensity * color, light.radius_m, half, light.blend)
    axis_u, axis_v = np.array(light.axis_u_m, np.float32), np.array(light.axis_v_m, np.float32)
    return RectangleLight(position, axis_u, axis_v, light.radiance * color)


def _from_environment(
    lights: documents.Lights,
) -> tuple[tuple[Light, ...], Float32[np.ndarray, "n n 3"]]:
    settings = lights.fisheye
    split = split_environment(
        load_environment(lights.environment),
        settings.count,
        threshold=settings.threshold,
        whole_map=settings.split == "all",
    )
    shining = tuple(
        DirectionalLight(
            (-light.toward).astype(np.float32), light.irradiance.astype(np.float32), light.angular_radius_rad
        )
        for light in split.lights
    )
    return shining, resample_to_octahedral(split.residual.sample, ENVIRONMENT_SIZE)
