"""Environment maps in latitude-longitude form: loading, orientation, area averaging, splitting into lights."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Self

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import is_file
from deltalight.protocol.frames import decode_lut
from deltalight.protocol.median_cut import PEAK_THRESHOLD, SkyGrid, Split, luminance_of, split_map
from deltalight.protocol.pictures import decode_rgb, read_bytes
from deltalight.protocol.radiance_files import LINEAR_SUFFIXES, read_linear
from deltalight.protocol.scene_lights import EnvironmentLights

WORK_SIZE = (512, 256)
MAX_EDGE = 16384
_CODED_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True, eq=False)
class EnvironmentMap:
    """Radiance from all directions, latitude-longitude, and its orientation in the world.

    In map axes (z up) the column coordinate u in [0, 1) has azimuth phi = pi (1 - 2 u) and the row
    coordinate v has elevation pi (0.5 - v): the direction is (cos phi cos e, sin phi cos e, sin e). So the
    centre looks along +x, +y is to its left, and v = 0 is up. Pixel (row j, column i) of (h, w) has its
    centre at u = (i + 0.5)/w, v = (j + 0.5)/h. `world_from_map` is a rotation.
    """

    radiance: Float32[np.ndarray, "h w 3"]
    world_from_map: Float64[np.ndarray, "3 3"]

    @property
    def grid(self) -> SkyGrid:
        """Directions and solid angles of the pixels."""
        return _grid(*self.radiance.shape[:2])

    @property
    def known_solid_angle(self) -> float:
        """All of the sphere, sr."""
        return float(4 * np.pi)

    def with_radiance(self, radiance: Float32[np.ndarray, "h w 3"]) -> Self:
        """Returns the map with other radiance."""
        return replace(self, radiance=radiance)

    def rolled(self, columns: int) -> "EnvironmentMap":
        """Returns the same light on a grid that begins at another column; the map's axes rotate along."""
        turned = orientation((0.0, 0.0, 1.0), -360 * columns / self.radiance.shape[1])
        return EnvironmentMap(np.roll(self.radiance, -columns, axis=1), self.world_from_map @ turned)

    def resized(self, width: int, height: int) -> "EnvironmentMap":
        """Returns a smaller map by averaging over solid angle; a larger size leaves the map as it is."""
        rows, columns = self.radiance.shape[:2]
        if rows <= height and columns <= width:
            return self
        weight = row_cosines(rows)[:, None, None]
        size = (width, height)
        weighted = cv2.resize(self.radiance * weight, size, interpolation=cv2.INTER_AREA)
        weights = cv2.resize(np.repeat(weight, columns, axis=1)[..., 0], size, interpolation=cv2.INTER_AREA)
        return EnvironmentMap((weighted / weights[..., None]).astype(np.float32), self.world_from_map)

    def sample(self, directions: Float[np.ndarray, "a b 3"]) -> Float32[np.ndarray, "a b 3"]:
        """Returns the radiance from world directions (of any length), bilinear."""
        x, y, z = np.moveaxis(directions @ self.world_from_map.astype(np.float32), -1, 0)
        rows, columns = self.radiance.shape[:2]
        u = 0.5 - np.arctan2(y, x) / (2 * np.pi)
        v = 0.5 - np.arctan2(z, np.hypot(x, y)) / np.pi
        wrapped = cv2.copyMakeBorder(self.radiance, 0, 0, 1, 1, cv2.BORDER_WRAP)
        column, row = (u * columns + 0.5).astype(np.float32), (v * rows - 0.5).astype(np.float32)
        return np.asarray(
            cv2.remap(wrapped, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
        )


def split_environment(
    environment: EnvironmentMap,
    count: int = 4,
    *,
    threshold: float = PEAK_THRESHOLD,
    whole_map: bool = False,
) -> Split[EnvironmentMap]:
    """Splits a latitude-longitude map as `split_map`, in its working size and opened where it is darkest."""
    small = environment.resized(*WORK_SIZE)
    bright = luminance_of(small.radiance)
    limit = threshold * float(np.vdot(bright, small.grid.solid_angles)) / small.known_solid_angle
    peaks = np.maximum(bright - np.float32(limit), 0) * small.grid.solid_angles
    opened = small.rolled(_darkest_column(peaks.sum(axis=0)))
    return split_map(opened, count, threshold=threshold, whole_map=whole_map)


def _darkest_column(columns: Float[np.ndarray, " w"]) -> int:
    """Finds where to open the map so that the seam is least likely to cut a light in two."""
    width = max(1, len(columns) // 64)
    around = np.convolve(np.concatenate([columns, columns[: width - 1]]), np.ones(width), "valid")
    return (int(np.argmin(around)) + width // 2) % len(columns)


def row_cosines(rows: int) -> Float32[np.ndarray, " h"]:
    """Returns the mean cosine of the elevation of every pixel row (its solid angle but for a constant)."""
    edges = np.sin(np.pi * (0.5 - np.arange(rows + 1) / rows))
    return np.asarray((edges[:-1] - edges[1:]) * rows / np.pi, np.float32)


def pixel_solid_angles(rows: int, columns: int) -> Float32[np.ndarray, "h 1"]:
    """Returns the solid angle of the pixels of every row, sr; over all pixels they add up to 4 pi."""
    return np.asarray(row_cosines(rows)[:, None] * np.float32(2 * np.pi**2 / (rows * columns)))


@lru_cache(maxsize=4)
def _grid(rows: int, columns: int) -> SkyGrid:
    solid_angles = np.repeat(pixel_solid_angles(rows, columns), columns, axis=1)
    return SkyGrid(map_directions(rows, columns), solid_angles)


def map_directions(rows: int, columns: int) -> Float32[np.ndarray, "h w 3"]:
    """Returns the directions of all pixels in map axes."""
    azimuth = np.pi * (1 - 2 * (np.arange(columns) + 0.5) / columns)
    elevation = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)[:, None]
    level = np.cos(elevation)
    parts = [
        level * np.cos(azimuth),
        level * np.sin(azimuth),
        np.broadcast_to(np.sin(elevation), (rows, columns)),
    ]
    return np.stack(parts, axis=-1).astype(np.float32)


def orientation(up: tuple[float, float, float], rotation_deg: float) -> Float64[np.ndarray, "3 3"]:
    """Returns world_from_map for an up axis and a rotation about it (counter-clockwise seen from above).

    Without rotation the map's centre looks along world +x, projected at right angles to `up` (along world +y
    where `up` is within 25 degrees of the x axis).
    """
    axis = np.asarray(up, np.float64) / np.linalg.norm(up)
    forward = np.array([0.0, 1, 0]) if abs(axis[0]) > 0.9 else np.array([1.0, 0, 0])
    forward -= (forward @ axis) * axis
    forward /= np.linalg.norm(forward)
    side = np.cross(axis, forward)
    angle = np.radians(rotation_deg)
    turned = np.cos(angle) * forward + np.sin(angle) * side
    return np.stack([turned, np.cross(axis, turned), axis], axis=1)


def load_environment(settings: EnvironmentLights) -> EnvironmentMap:
    """Reads the environment map that a scene document names, scaled by its intensity.

    `.hdr` and `.exr` files are linear; `.png` and `.jpg` are read as sRGB and hold no light brighter than 1.

    Raises:
        DeltalightError: the file is missing, unreadable, not twice as wide as high, or of another type; or it is
            `.exr` and the package OpenEXR is not installed.
    """
    if settings.map is None:
        raise DeltalightError("lights of mode environment need `environment.map`; name a .hdr or .exr file.")
    radiance = read_radiance(Path(settings.map)) * np.float32(settings.intensity)
    return EnvironmentMap(radiance, orientation(settings.up, settings.rotation_deg))


def read_radiance(path: Path) -> Float32[np.ndarray, "h w 3"]:
    """Reads a latitude-longitude picture as linear R G B; negative values become 0.

    Raises:
        DeltalightError: as `load_environment`.
    """
    suffix = path.suffix.lower()
    if not is_file(path):
        raise DeltalightError(f"the environment map {path} does not exist; correct the path.")
    if suffix in LINEAR_SUFFIXES:
        radiance = read_linear(path)
    elif suffix in _CODED_SUFFIXES:
        radiance = decode_lut(None)[:, 0][decode_rgb(read_bytes(path), str(path))]
    else:
        raise DeltalightError(f"{path} is not an environment map; use a .hdr or .exr file (or .png, .jpg).")
    _check_shape(radiance, path)
    return radiance


def _check_shape(radiance: Float32[np.ndarray, "h w 3"], path: Path) -> None:
    rows, columns = radiance.shape[:2]
    if columns != 2 * rows or columns > MAX_EDGE or rows < 2:
        raise DeltalightError(
            f"{path} has {columns}x{rows} pixels; a latitude-longitude map must be twice as wide as "
            f"it is high (and at most {MAX_EDGE} wide)."
        )
