"""Garden table under sun and sky: light from an environment map only."""

from typing import Any

import numpy as np
from jaxtyping import Float32

from deltalight.benchmarks.ground_truth import rooms
from deltalight.benchmarks.ground_truth.benchmark_scene import BenchmarkScene, Finish, VirtualObject
from deltalight.benchmarks.ground_truth.meshes import rabbit, ring
from deltalight.benchmarks.ground_truth.parts import MeshFolder, looking
from deltalight.benchmarks.ground_truth.textures import smooth_noise

SUN_DIRECTION = np.array([0.62, -0.42, 0.66])
SUN_RADIUS = np.radians(3.0)
"""A sun behind thin haze: wide enough that a map of 512 columns resolves its disc."""
SUN_RADIANCE = np.array([250.0, 225.0, 185.0])
ZENITH, HORIZON, GROUND = (
    np.array([0.14, 0.24, 0.48]),
    np.array([0.52, 0.56, 0.60]),
    np.array([0.13, 0.14, 0.08]),
)


def _sky() -> Float32[np.ndarray, "256 512 3"]:
    """Returns a sky that is whitest at the horizon and around the sun, over grass.

    Rows from above, centre column +x.
    """
    azimuth = np.pi * (1 - 2 * (np.arange(512) + 0.5) / 512)
    elevation = np.pi * (0.5 - (np.arange(256) + 0.5) / 256)[:, None]
    parts = np.broadcast_arrays(
        np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    )
    height = np.clip(parts[2], 0, 1)[..., None]
    to_sun = SUN_DIRECTION / np.linalg.norm(SUN_DIRECTION)
    angle = np.arccos(np.clip(np.stack(parts, axis=-1) @ to_sun, -1, 1))[..., None]
    glow = 0.9 * np.exp(-angle / 0.25) * np.array([1.0, 0.93, 0.80])
    sky = HORIZON + (ZENITH - HORIZON) * np.sqrt(height) + glow
    disc = np.clip((SUN_RADIUS - angle) / np.radians(0.7) + 0.5, 0, 1)  # its rim falls off within one pixel
    grass = GROUND * np.exp(0.22 * smooth_noise(np.random.default_rng(2), 256, 512, 64, 128))[..., None]
    return np.where(parts[2][..., None] > 0, sky + disc * SUN_RADIANCE, grass).astype(np.float32)


def _real(folder: MeshFolder) -> dict[str, Any]:
    things = {
        "crate": rooms.standing_box(0.04, 0.13, (0.15, 0.10, 0.08), 18.0, (0.60, 0.33, 0.20)),
        "brick": rooms.standing_box(0.36, 0.16, (0.11, 0.055, 0.07), -28.0, (0.50, 0.16, 0.09)),
        "mug": rooms.mug(folder, rooms.standing(0.23, 0.18, turn_deg=-60), (0.14, 0.30, 0.42)),
    }
    return rooms.wooden_table(21) | things


SCENE = BenchmarkScene(
    name="natural_light",
    title="Natural light: sun and sky",
    world_from_camera=(looking((0.22, -0.38, 0.29), (0.165, -0.01, 0.045)),),
    real=_real,
    objects=(
        VirtualObject(
            "rabbit",
            rabbit,
            Finish((0.74, 0.70, 0.62), specular=0.0),
            (rooms.standing(0.265, 0.0, turn_deg=-35),),
        ),
        VirtualObject(
            "ring",
            ring,
            Finish((0.56, 0.10, 0.30), roughness=0.3),
            (rooms.standing(0.12, -0.03, 0.0, 50),),
        ),
    ),
    environment=_sky,
)
