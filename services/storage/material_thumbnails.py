"""Small pictures of precomputed materials: a ball of a measured paint, a lit square of a texture by the light."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from deltalight.render_server.scene.gaussian_brdf import GaussianBrdf
from deltalight.render_server.scene.material_file import read_material
from deltalight.render_server.scene.textures_by_light import TextureByLight
from deltalight.services.storage.asset_kinds import Facts
from deltalight.services.storage.thumbnails import (
    AMBIENT_LIGHT,
    FILL,
    FILL_LIGHT,
    KEY,
    KEY_LIGHT,
    MARGIN,
    SAMPLES,
    SIZE,
    Pixels,
    reduced,
    write_picture,
)

LIGHTS = ((KEY_LIGHT, KEY), (FILL_LIGHT, FILL))


def draw_material(path: Path, out: str) -> Facts:
    """Writes a precomputed material as PNG on a transparent ground, under the lights of all thumbnails.

    Raises:
        DeltalightError: the material cannot be read.
    """
    material = read_material(path)
    write_picture(out, _ball(material) if isinstance(material, GaussianBrdf) else _square(material))
    return {}


def _ball(material: GaussianBrdf) -> Pixels:
    """Returns a ball of the material, seen from far away."""
    edge = SIZE * SAMPLES
    right, down = np.meshgrid(*[(2 * (np.arange(edge) + 0.5) / edge - 1) * MARGIN] * 2)
    covered = right**2 + down**2 < 1
    x, y = right[covered], -down[covered]
    normals = np.stack([x, y, np.sqrt(1 - x * x - y * y)], axis=1)
    color = np.tile(AMBIENT_LIGHT * material.hemispherical_albedo, (len(normals), 1))
    for strength, direction in LIGHTS:
        color += strength * _reflected(material, normals, direction / np.linalg.norm(direction))
    pixels = np.zeros((edge, edge, 4), np.float32)
    pixels[covered] = np.column_stack([color, np.ones(len(color))])
    return reduced(pixels)


def _reflected(
    material: GaussianBrdf, normals: Float64[np.ndarray, "n 3"], light: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "n 3"]:
    """Returns the radiance towards the camera (z) of surfaces under a light that a white one would show as 1."""
    cosine = normals @ light
    found = np.zeros_like(normals)
    lit = cosine > 0
    along = [_in_tangent_frame(np.array(way, np.float64), normals[lit]) for way in (light, (0, 0, 1))]
    found[lit] = np.pi * material.evaluate(*along) * cosine[lit, None]
    return found


def _in_tangent_frame(
    direction: Float64[np.ndarray, "3"], normals: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Returns a direction in frames whose z is each normal (Duff et al. 2017; normals have z > 0)."""
    x, y, z = normals.T
    across = -1 / (1 + z)
    tangent = np.stack([1 + across * x * x, across * x * y, -x], axis=1)
    bitangent = np.stack([across * x * y, 1 + across * y * y, -y], axis=1)
    return np.stack([frame @ direction for frame in (tangent, bitangent, normals)], axis=1)


def _square(material: TextureByLight) -> Pixels:
    """Returns the texture, seen from in front, in the middle of the picture."""
    height, width = material.albedo.shape[:2]
    scale = SIZE / max(height, width)
    size = [max(1, round(edge * scale)) for edge in (width, height)]
    color = AMBIENT_LIGHT * _resized(material.albedo, size)
    for strength, direction in LIGHTS:
        shown = material.under(np.asarray(direction / np.linalg.norm(direction), np.float64))
        color += strength * _resized(shown, size)
    picture = np.zeros((SIZE, SIZE, 4), np.float32)
    top, left = (SIZE - size[1]) // 2, (SIZE - size[0]) // 2
    picture[top : top + size[1], left : left + size[0]] = np.dstack([color, np.ones(color.shape[:2])])
    return picture


def _resized(texels: np.ndarray, size: list[int]) -> Float32[np.ndarray, "h w 3"]:
    return np.asarray(cv2.resize(texels.astype(np.float32), size, interpolation=cv2.INTER_AREA), np.float32)
