"""Polynomial texture maps (Malzbender et al. 2001): texels by the light's direction (docs/method.md 6.8)."""

import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float16, Float32, Float64
from PIL import Image

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import decode_lut
from deltalight.render_server.lights.octahedral import even_directions

TERMS = 6  # 1, lu, lv, lu^2, lu lv, lv^2
INFO_NAME = "info.json"
MOST_TEXELS_EDGE = 512  # that are kept
_LARGEST_PLANE_PIXELS = 64_000_000
_DIRECTIONS = 64  # over which a texel's albedo is averaged
_ROWS = 32  # of texels that are decoded at a time
_ADVICE = "export it again as a PTM of RGB coefficients (18 planes in JPEG)"


@dataclass(frozen=True, eq=False)
class PolynomialTexture:
    """Six coefficients a texel, of a polynomial that gives the picture's sRGB code / 255.

    Decoded, it is the radiance relative to that of a white Lambertian which the light meets head-on: times the
    irradiance across the light's beam / pi. Row 0 is the top; lu and lv are the light's direction along the picture's
    right and upward edges.
    """

    coefficients: Float16[np.ndarray, "6 h w 3"]

    @cached_property
    def albedo(self) -> Float16[np.ndarray, "h w 3"]:
        """What each texel reflects of light from everywhere: twice the mean over directions, at most 1."""
        above = even_directions(2 * _DIRECTIONS)[:_DIRECTIONS]
        terms, decode = polynomial_terms(above), decode_lut(None)[:, 0]
        found = np.empty(self.coefficients.shape[1:], np.float16)
        for first in range(0, len(found), _ROWS):
            part = self.coefficients[:, first : first + _ROWS].astype(np.float32)
            codes = np.clip(np.tensordot(terms.astype(np.float32), part, 1) * 255 + 0.5, 0, 255).astype(
                np.uint8
            )
            found[first : first + _ROWS] = np.minimum(2 * decode[codes].mean(axis=0), 1)
        return found


def polynomial_terms(directions: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 6"]:
    """Returns what the coefficients are multiplied by for unit directions to the light."""
    u, v = directions[:, 0], directions[:, 1]
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)


def read_polynomial_texture(folder: Path) -> PolynomialTexture:
    """Reads a PTM in the web format of Relight: `info.json` and `plane_0.jpg` to `plane_5.jpg`.

    Raises:
        DeltalightError: a file is missing or damaged, or it is another kind of map.
    """
    info = _info(folder / INFO_NAME)
    try:
        scale, bias = (_array(info["materials"][0][key]).reshape(TERMS, 1, 1, 3) for key in ("scale", "bias"))
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise DeltalightError(f"{folder / INFO_NAME} lacks whole scales and biases; {_ADVICE}.") from error
    each = [_plane(folder / f"plane_{term}.jpg") for term in range(TERMS)]
    if len({plane.shape for plane in each}) > 1:
        raise DeltalightError(f"the planes of {folder} have several sizes; {_ADVICE}.")
    return PolynomialTexture(np.asarray((np.stack(each) / 255 - bias) * scale, np.float16))


def _info(path: Path) -> dict[str, Any]:
    try:
        info = json.loads(path.read_text())
    except OSError as error:
        raise DeltalightError(
            f"{path} cannot be read ({error.strerror}); a PTM is a folder with it."
        ) from error
    except ValueError as error:
        raise DeltalightError(f"{path} is no JSON document; {_ADVICE}.") from error
    kind = (info.get("type"), info.get("colorspace"), info.get("nplanes")) if isinstance(info, dict) else None
    if kind != ("ptm", "rgb", 3 * TERMS):
        raise DeltalightError(f"{path} describes no PTM of RGB coefficients; {_ADVICE}.")
    return dict(info)


def _array(numbers: object) -> Float64[np.ndarray, "..."]:
    """Raises ValueError or TypeError if these are no finite numbers."""
    array = np.array(numbers, np.float64)
    if not np.isfinite(array).all():
        raise ValueError
    return array


def _plane(path: Path) -> Float32[np.ndarray, "h w 3"]:
    """Returns the codes of a plane, averaged down to MOST_TEXELS_EDGE."""
    try:
        with Image.open(path) as image:
            if image.width * image.height > _LARGEST_PLANE_PIXELS:
                raise DeltalightError(f"{path} has {image.width}x{image.height} pixels, which is too many.")
            codes = np.asarray(image.convert("RGB"), np.float32)
    except OSError as error:
        raise DeltalightError(f"{path} cannot be read as a picture; {_ADVICE}.") from error
    by = MOST_TEXELS_EDGE / max(codes.shape[:2])
    if by >= 1:
        return codes
    size = tuple(max(1, math.floor(edge * by + 0.5)) for edge in codes.shape[1::-1])
    return np.asarray(cv2.resize(codes, size, interpolation=cv2.INTER_AREA), np.float32)
