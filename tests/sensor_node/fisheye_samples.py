"""Fish-eye lenses and pictures made for tests."""

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.fisheye_lens import FisheyeCalibration, FisheyeLens
from deltalight.protocol.frames import FisheyePictures, decode_lut
from deltalight.protocol.ocam_lens import OcamLens


def equidistant(edge: int, degrees: float = 190.0, circle: float | None = None) -> EquidistantLens:
    """Returns a lens whose field of view fills a square picture; its axis is not in the very middle."""
    focal = edge / np.radians(degrees)
    matrix = np.array([[focal, 0, (edge - 1) / 2 + 0.3], [0, focal, (edge - 1) / 2 - 0.2], [0, 0, 1]])
    return EquidistantLens(CameraModel(edge, edge, matrix, "equidistant", np.zeros(4)), circle)


def ocam(edge: int) -> OcamLens:
    """Returns a polynomial lens of about 200 degrees."""
    focal = 0.3 * edge
    return OcamLens(
        edge, edge, (focal, 0.0, -0.8 / focal, 0.1 / focal**2), (edge / 2, edge / 2), (1.0, 0.001, 0.0)
    )


def coded(light: Float64[np.ndarray, "h w 3"], exposure: float) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the sRGB codes of one exposure of linear light."""
    table = decode_lut(None)[:, 0].astype(np.float64)
    middles = (table[1:] + table[:-1]) / 2
    return np.searchsorted(middles, light * exposure).astype(np.uint8)


def bracket(
    light: Float64[np.ndarray, "h w 3"], exposures_s: tuple[float | None, ...], lens: FisheyeLens
) -> FisheyePictures:
    """Returns sRGB pictures of light whose unit is white at 1 s."""
    pictures = tuple(coded(light, 1.0 if exposure is None else exposure) for exposure in exposures_s)
    return FisheyePictures(5, pictures, exposures_s, FisheyeCalibration(lens))


def pixel_solid_angles(
    lens: FisheyeLens,
) -> tuple[Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
    """Returns each pixel's solid angle (0 below the horizon and outside) and cosine of its angle from the axis."""
    columns, rows = np.meshgrid(np.arange(float(lens.width)), np.arange(float(lens.height)))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    step = 1e-3
    across, down = (
        lens.directions(pixels + np.array(shift)) - lens.directions(pixels - np.array(shift))
        for shift in ((step, 0.0), (0.0, step))
    )
    solid = np.linalg.norm(np.cross(across, down), axis=1) / (2 * step) ** 2
    cosine = lens.directions(pixels)[:, 2]
    solid = np.where(np.isfinite(solid) & (cosine > 0), solid, 0.0)
    shape = lens.height, lens.width
    return solid.reshape(shape), np.nan_to_num(cosine).reshape(shape)


def even(lens: FisheyeLens) -> Float32[np.ndarray, "h w 3"]:
    """Returns a linear picture of 1 everywhere."""
    return np.ones((lens.height, lens.width, 3), np.float32)
