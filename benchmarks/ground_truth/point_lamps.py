"""Point lamps in the fish-eye picture, blurred by the lens, because no pixel's rays hit Mitsuba's points."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float32

from deltalight.benchmarks.ground_truth.lamps import Lamp, Spot
from deltalight.benchmarks.ground_truth.parts import Matrix
from deltalight.benchmarks.ground_truth.render import RoomRenderer
from deltalight.protocol.equidistant_lens import EquidistantLens

LENS_BLUR_PX = 1.5
"""Standard deviation of the spot that a wide lens makes of a point; its energy is that of the point."""


def point_lamps(lamps: Iterable[Lamp]) -> list[Spot]:
    """Returns the lamps that no camera would see."""
    return [lamp for lamp in lamps if isinstance(lamp, Spot)]


def with_point_lamps(
    picture: Float32[np.ndarray, "h w 3"],
    lamps: Iterable[Lamp],
    room: RoomRenderer,
    lens: EquidistantLens,
    pose: Matrix,
) -> Float32[np.ndarray, "h w 3"]:
    """Returns a linear fish-eye picture with the blurs of all point lamps that the lens at `pose` sees.

    The blur's radiance over the solid angle of its pixels adds up to the irradiance across the beam there.
    """
    eye = pose[:3, 3]
    for lamp in point_lamps(lamps):
        offset = np.array(lamp.position_m) - eye
        place = lens.project((offset @ pose[:3, :3])[None])[0]
        if np.isfinite(place).all() and room.is_free(eye, np.array(lamp.position_m)):
            picture = picture + _blur(lens, place) * lamp.irradiance(eye).astype(np.float32)
    return picture


def _blur(lens: EquidistantLens, place: np.ndarray) -> Float32[np.ndarray, "h w 1"]:
    """Returns the radiance of unit irradiance spread over the pixels around `place`."""
    columns, rows = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    squared = (columns - place[0]) ** 2 + (rows - place[1]) ** 2
    weight = np.exp(-squared / (2 * LENS_BLUR_PX**2))
    total = float((weight * _solid_angles(lens)).sum())
    return np.asarray(weight / total, np.float32)[..., None]


def _solid_angles(lens: EquidistantLens) -> np.ndarray:
    """Returns every pixel's solid angle, sr, by the cross product of the steps of its ray; 0 without a ray."""
    columns, rows = np.meshgrid(np.arange(lens.width, dtype=float), np.arange(lens.height, dtype=float))
    rays = lens.directions(np.stack([columns, rows], axis=-1).reshape(-1, 2)).reshape(
        lens.height, lens.width, 3
    )
    across, down = np.gradient(rays, axis=1), np.gradient(rays, axis=0)
    return np.asarray(np.nan_to_num(np.linalg.norm(np.cross(across, down), axis=-1)))
