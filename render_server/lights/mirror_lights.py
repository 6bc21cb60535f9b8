"""Images of lights in smooth real planes: a polished table lights things on it from below."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64

from deltalight.render_server.lights.light_models import DirectionalLight, Light
from deltalight.render_server.scene.declared_surfaces import PLANE, SurfaceTable

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
    """Returns images of lights in smooth declared planes in front of which they and `objects` (a point, m) lie."""
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
    """Mirrors a light, enlarged by the blur that the objects see; None if it is not in front of the plane.

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
    return light.image(_single(position), reflection, blur_m)


def _single(vector: Float64[np.ndarray, "3"]) -> Float32[np.ndarray, "3"]:
    return np.asarray(vector, np.float32)
