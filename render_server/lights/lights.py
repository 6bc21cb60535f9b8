"""Lights of a scene as the renderer uses them: light models, their images in smooth planes, a smooth environment."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from protocol import scene_lights as documents
from render_server.lights.environment import load_environment
from render_server.lights.median_cut import split_environment
from render_server.lights.octahedral import above_horizon, resample_to_octahedral, solid_angle_mean
from render_server.scene.declared_surfaces import PLANE, SurfaceTable

ENVIRONMENT_SIZE = 256
AMBIENT_SIZE = 64  # texels of 1.5 to 5 degrees: a metal of roughness 0.3 still resolves the edge of a wall
MIN_DISTANCE_M = 1e-6


@dataclass(frozen=True, eq=False)
class DirectionalLight:
    """A distant light: `direction` of travel (unit, world), `irradiance` across the beam."""

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
    """An isotropic lamp: E = I cos/d^2; position in metres, world."""

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

    `environment` is the residual radiance map R without the lights, octahedral, world axes. `ground_fraction` (0..1)
    is the fraction of each of its texels that shows the real ground, because nothing else is known to be there.
    `registration` is the factor R G B that `lights` and `environment` still lack, ones where it is to be estimated
    from the picture. `identities` number the lights where they are tracked over time.
    """

    lights: tuple[Light, ...]
    environment: Float32[np.ndarray, "n n 3"]
    ground_fraction: Float32[np.ndarray, "n n 1"]
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
        """Return the set with ground of this radiance in `ground_fraction` of its environment."""
        ground = np.broadcast_to(radiance, self.environment.shape)
        return self.with_surfaces(ground, self.ground_fraction)

    def with_surfaces(
        self, radiance: Float32[np.ndarray, "n n 3"], fraction: Float32[np.ndarray, "n n 1"]
    ) -> "LightSet":
        """Return the set with surfaces (maps of the environment's size) in front of a fraction of each texel."""
        return replace(self, environment=(1 - fraction) * self.environment + fraction * radiance)

    def with_sky(self, radiance: Float32[np.ndarray, "3"], shape: Float32[np.ndarray, "n n 1"]) -> "LightSet":
        """Return the set with radiance added above the horizon, times `shape` (of the environment's size)."""
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
    """Build the light set of a scene document in mode `manual` or `environment`.

    An environment is split by the settings of `lights.fisheye`, as in mode `fisheye`.

    Raises:
        DeltalightError: an environment map that cannot be read.
    """
    shining, environment = (
        _from_environment(lights) if lights.mode == "environment" else _manual(lights.manual)
    )
    return light_set(lights, shining, environment, 1 - above_horizon(len(environment)))


def light_set(
    lights: documents.Lights,
    shining: tuple[Light, ...],
    environment: Float32[np.ndarray, "n n 3"],
    ground_fraction: Float32[np.ndarray, "n n 1"],
    identities: tuple[int, ...] = (),
) -> LightSet:
    """Assemble a light set with the registration that a scene document requests."""
    given = lights.resolved_registration
    factor = np.ones(3, np.float32) if given == "auto" else np.array(given, np.float32)
    return LightSet(shining, environment, ground_fraction, factor, identities)


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
            (-light.to_light).astype(np.float32),
            light.irradiance.astype(np.float32),
            light.angular_radius_rad,
        )
        for light in split.lights
    )
    return shining, resample_to_octahedral(split.residual.sample, ENVIRONMENT_SIZE)


@dataclass(frozen=True, eq=False)
class IncidentLight:
    """Light as it arrives at positions: unit direction to it (world), irradiance on a surface that faces it."""

    to_light: Float64[np.ndarray, "*n 3"]
    irradiance: Float64[np.ndarray, "*n 3"]
    angular_radius_rad: Float64[np.ndarray, "*n"]


def incident_light(light: Light, position: Float64[np.ndarray, "*n 3"]) -> IncidentLight:
    """Return the unoccluded light at positions (world, m)."""
    if isinstance(light, DirectionalLight):
        to_light = np.broadcast_to(-light.direction.astype(np.float64), position.shape)
        irradiance = np.broadcast_to(light.irradiance.astype(np.float64), position.shape)
        return IncidentLight(to_light, irradiance, np.full(position.shape[:-1], light.angular_radius_rad))
    offset = light.position.astype(np.float64) - position
    distance = np.maximum(np.linalg.norm(offset, axis=-1), MIN_DISTANCE_M)
    to_light = offset / distance[..., None]
    if isinstance(light, RectangleLight):
        edges = np.cross(light.axis_u.astype(np.float64), light.axis_v.astype(np.float64))
        shown = np.maximum(-to_light @ edges, 0.0)  # area across the line of sight, m^2
        irradiance = light.radiance.astype(np.float64) * (shown / distance**2)[..., None]
        return IncidentLight(to_light, irradiance, np.arctan(np.sqrt(shown / np.pi) / distance))
    irradiance = light.intensity.astype(np.float64) / distance[..., None] ** 2
    if isinstance(light, SpotLight):
        irradiance = irradiance * _within_cone(light, to_light)[..., None]
    return IncidentLight(to_light, irradiance, _angular_radius(light, distance))


def _within_cone(light: SpotLight, to_light: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n"]:
    """Return the fraction of a spot's intensity that it emits against `to_light`."""
    angle = np.arccos(np.clip(-to_light @ light.direction, -1, 1))
    soft = max(light.half_angle_rad - light.full_angle_rad, 1e-9)
    return np.asarray(np.clip((light.half_angle_rad - angle) / soft, 0, 1))


def _angular_radius(
    light: SphereLight | SpotLight, distance: Float64[np.ndarray, "*n"]
) -> Float64[np.ndarray, "*n"]:
    return np.asarray(np.arcsin(np.minimum(light.radius_m / distance, 1.0)))


# Of planes. From this roughness on, a lobe blurs a light's image so much that cones represent it.
MIRROR_ROUGHNESS = 0.3
MIN_COSINE = 0.05  # lights at grazing angles have no image of their own


@dataclass(frozen=True, eq=False)
class MirrorLight:
    """The image of a light in a plane, which shines in front of it, attenuated by the plane's reflectance.

    `plane` (a, b, c, d; unit normal towards the objects) has ax + by + cz + d > 0 in front of it; `surface` is its
    row in the table of surfaces, `source` the index of the light.
    """

    light: Light
    plane: Float64[np.ndarray, "4"]
    tolerance_m: float
    f0: Float32[np.ndarray, "3"]
    roughness: float
    surface: int
    source: int


def mirror_lights(
    lights: Sequence[Light], surfaces: SurfaceTable, objects: Float64[np.ndarray, "3"]
) -> list[MirrorLight]:
    """Return images of lights in smooth declared planes in front of which they and `objects` (a point, m) lie."""
    found = []
    for index, row in enumerate(surfaces.packed):
        roughness = float(surfaces.roughness[index])
        if row[3, 3] != PLANE or roughness >= MIRROR_ROUGHNESS or not surfaces.f0[index].any():
            continue
        plane = _plane_towards(row[3, :3].astype(float), row[4, :3].astype(float), objects)
        for source, light in enumerate(lights):
            image = _image(light, plane, roughness**2, objects)
            if image is not None:
                tolerance_m = float(row[4, 3])
                found.append(
                    MirrorLight(image, plane, tolerance_m, surfaces.f0[index], roughness, index, source)
                )
    return found


def _plane_towards(
    point: Float64[np.ndarray, "3"], normal: Float64[np.ndarray, "3"], side: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "4"]:
    unit = normal / np.linalg.norm(normal)
    plane = np.append(unit, -unit @ point)
    return plane if unit @ side + plane[3] >= 0 else -plane


def _image(
    light: Light, plane: Float64[np.ndarray, "4"], alpha: float, objects: Float64[np.ndarray, "3"]
) -> Light | None:
    """Mirror a light, enlarged by the blur that the objects see; None if it is not in front of the plane.

    A GGX lobe of alpha spreads directions by 2 alpha; at the light's distance b from the plane that is 2 alpha b.
    """
    normal = plane[:3]
    reflection = np.eye(3) - 2 * np.outer(normal, normal)
    if isinstance(light, DirectionalLight):
        if -light.direction @ normal < MIN_COSINE:
            return None
        radius = float(np.arctan(np.hypot(np.tan(light.angular_radius_rad), 2 * alpha)))
        return replace(light, direction=_single(reflection @ light.direction), angular_radius_rad=radius)
    height = float(normal @ light.position + plane[3])
    position = light.position.astype(float) - 2 * height * normal
    to_objects = objects - position
    if height <= 0 or normal @ to_objects < MIN_COSINE * np.linalg.norm(to_objects):
        return None
    blur_m = 2 * alpha * height * float(np.linalg.norm(to_objects)) / float(normal @ to_objects)
    if isinstance(light, RectangleLight):
        return _rectangle_image(light, position, reflection, blur_m)
    moved = replace(light, position=_single(position), radius_m=float(np.hypot(light.radius_m, blur_m)))
    if isinstance(moved, SpotLight):
        return replace(moved, direction=_single(reflection @ moved.direction))
    assert isinstance(moved, SphereLight)
    return moved


def _rectangle_image(
    light: RectangleLight,
    position: Float64[np.ndarray, "3"],
    reflection: Float64[np.ndarray, "3 3"],
    blur_m: float,
) -> RectangleLight:
    """Mirror a rectangle: its axes change places to keep the orientation, and blur widens it at the same flux."""
    u, v = (float(np.linalg.norm(axis)) for axis in (light.axis_u, light.axis_v))
    grown = [float(np.hypot(edge, 2 * blur_m) / edge) for edge in (u, v)]
    return RectangleLight(
        _single(position),
        _single(reflection @ light.axis_v * grown[1]),
        _single(reflection @ light.axis_u * grown[0]),
        light.radiance / np.float32(grown[0] * grown[1]),
    )


def _single(vector: Float64[np.ndarray, "3"]) -> Float32[np.ndarray, "3"]:
    return np.asarray(vector, np.float32)
