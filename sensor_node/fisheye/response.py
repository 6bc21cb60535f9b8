"""Camera response from an exposure bracket (Debevec & Malik 1997)."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from deltalight.protocol.errors import DeltalightError
from deltalight.sensor_node.fisheye.exposures import CLIPPED_CODE

SAMPLES = 256
"""Pixels whose codes are compared: as many as codes, so that each code occurs about once per exposure."""
SMOOTHNESS = 20.0
"""Weight of the curve's second differences, which couples codes within about 20^(1/2) codes.

Responses bend no finer; 100 gives the same curve within 0.01 of white.
"""
BLACK_CODE = 5
"""Codes up to here are noise, dark offset and stray light rather than the scene."""


def estimate_response(
    pictures: Sequence[UInt8[np.ndarray, "h w 3"]], exposures_s: Sequence[float]
) -> Float32[np.ndarray, "256 3"]:
    """Returns linear R G B of each code, 1.0 = white in each channel, from pictures of one still scene.

    Only the ratios of exposures matter; three or more, one to three stops apart, that cover black to white.

    Raises:
        DeltalightError: fewer than two different exposures, or pictures that are not coded in 8 bits.
    """
    if len(pictures) != len(exposures_s) or len(set(exposures_s)) < 2 or min(exposures_s) <= 0:
        raise DeltalightError(
            "a response needs a bracket of at least two different exposures; give each picture's exposure in s."
        )
    if any(picture.dtype != np.uint8 or picture.shape != pictures[0].shape for picture in pictures):
        raise DeltalightError("a response needs coded 8-bit pictures of one size; linear pictures need none.")
    codes = _sample(pictures)
    log_exposures = np.log(np.asarray(exposures_s, np.float64))
    curves = [_solve(codes[..., channel], log_exposures) for channel in range(3)]
    return np.stack(curves, axis=1).astype(np.float32)


def _sample(pictures: Sequence[UInt8[np.ndarray, "h w 3"]]) -> UInt8[np.ndarray, "exposures n 3"]:
    """Returns codes of pixels in flat areas (so that blur does not mix them), spread evenly over brightness."""
    total = np.sum([picture.astype(np.float32).mean(axis=-1) for picture in pictures], axis=0)
    window = np.ones((5, 5), np.uint8)
    roughness = (cv2.dilate(total, window) - cv2.erode(total, window)).ravel()
    scale = (SAMPLES - 1e-3) / max(float(np.ptp(total)), 1e-3)
    level = ((total.ravel() - total.min()) * scale).astype(np.intp)
    order = np.lexsort((roughness, level))
    first = np.unique(level[order], return_index=True)[1]
    rows, columns = np.unravel_index(order[first], total.shape)
    return np.stack([picture[rows, columns] for picture in pictures])


def _solve(
    codes: UInt8[np.ndarray, "exposures n"], log_exposures: Float64[np.ndarray, " exposures"]
) -> Float64[np.ndarray, "256"]:
    """Solves g(code) = ln radiance + ln exposure by least squares, with a hat weight and a smooth g."""
    count, pixels = codes.shape
    code = np.arange(256)
    hat = np.minimum(code - BLACK_CODE, CLIPPED_CODE - code) / ((CLIPPED_CODE - BLACK_CODE) / 2)
    hat = np.maximum(hat, 0.0)
    weight = hat[codes].ravel()
    rows = np.arange(count * pixels)
    data = np.zeros((rows.size, 256 + pixels))
    data[rows, codes.ravel()] = weight
    data[rows, 256 + rows % pixels] = -weight
    bend = np.zeros((254, 256 + pixels))
    for offset, factor in enumerate((1.0, -2.0, 1.0)):
        bend[np.arange(254), np.arange(254) + offset] = factor * SMOOTHNESS
    fix = np.zeros((1, 256 + pixels))
    fix[0, 128] = 1.0  # g is determined up to a constant: any value will do
    target = np.concatenate([weight * np.repeat(log_exposures, pixels), np.zeros(255)])
    g = np.linalg.lstsq(np.vstack([data, bend, fix]), target, rcond=None)[0][:256]
    return np.asarray(np.exp(np.maximum.accumulate(g) - g.max()))
