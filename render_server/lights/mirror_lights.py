"""Lights as smooth real planes mirror them: a polished table lights what stands on it from below."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64

from render_server.lights.lights import DirectionalLight, Light, RectangleLight, SphereLight, SpotLight
from render_server.scene.declared_surfaces import PLANE, SurfaceTable

# Of planes; from here on a lobe spreads a light's image so far that it is no light any more, and cones serve.
MIRROR_ROUGHNESS = 0.3
LEAST_COSINE = 0.05  # a light that grazes the plane has no image of its own there


@dataclass(frozen=True, eq=False)
class MirrorLight:
    """The image of a light in a plane. It shines before the plane, as much as the plane reflects of it.

    `plane` (a, b, c, d; unit normal towards the objects) has ax + by + cz + d > 0 before it; `surface` is its row in
    the table of surfaces, `source` the light's number.
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
    """Images of the lights in the smooth declared planes that they and `objects` (a point, world, m) are before."""
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
    """The light behind the plane, as large as its image is seen from the objects; None if it is not before the plane.

    A GGX lobe of alpha spreads the way by 2 alpha; at the light's distance b from the plane that is 2 alpha b across.
    """
    normal = plane[:3]
    turn = np.eye(3) - 2 * np.outer(normal, normal)
    if isinstance(light, DirectionalLight):
        if -light.direction @ normal < LEAST_COSINE:
            return None
        radius = float(np.arctan(np.hypot(np.tan(light.angular_radius_rad), 2 * alpha)))
        return replace(light, direction=_single(turn @ light.direction), angular_radius_rad=radius)
    height = float(normal @ light.position + plane[3])
    position = light.position.astype(float) - 2 * height * normal
    to_objects = objects - position
    if height <= 0 or normal @ to_objects < LEAST_COSINE * np.linalg.norm(to_objects):
        return None
    wider = 2 * alpha * height * float(np.linalg.norm(to_objects)) / float(normal @ to_objects)
    if isinstance(light, RectangleLight):
        return _rectangle_image(light, position, turn, wider)
    moved = replace(light, position=_single(position), radius_m=float(np.hypot(light.radius_m, wider)))
    if isinstance(moved, SpotLight):
        return replace(moved, direction=_single(turn @ moved.direction))
    assert isinstance(moved, SphereLight)
    return moved


def _rectangle_image(
    light: RectangleLight, position: Float64[np.ndarray, "3"], turn: Float64[np.ndarray, "3 3"], wider: float
) -> RectangleLight:
    """Its axes change places, as a mirror image turns about; wider at the same flux."""
    u, v = (float(np.linalg.norm(axis)) for axis in (light.axis_u, light.axis_v))
    grown = [float(np.hypot(edge, 2 * wider) / edge) for edge in (u, v)]
    return RectangleLight(
        _single(position),
        _single(turn @ light.axis_v * grown[1]),
        _single(turn @ light.axis_u * grown[0]),
        light.radiance / np.float32(grown[0] * grown[1]),
    )


def _single(vector: Float64[np.ndarray, "3"]) -> Float32[np.ndarray, "3"]:
    return np.asarray(vector, np.float32)
