"""Polynomial texture maps (Malzbender et al. 2001): texels by the light's direction (docs/method.md 6.8)."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float16, Float32, Float64

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import decode_lut
from deltalight.render_server.lights.octahedral import even_directions
from deltalight.render_server.scene.texture_folder import (
    INFO_NAME,
    averaged,
    finite_array,
    read_codes,
    read_info,
)

TERMS = 6  # 1, lu, lv, lu^2, lu lv, lv^2
POLYNOMIAL_TYPE = "ptm"
MOST_TEXELS_EDGE = 512  # that are kept
_DIRECTIONS = 64  # over which a texel's albedo is averaged
_ROWS = 32  # of texels that are decoded at a time
_SEPARATE = (POLYNOMIAL_TYPE, "rgb", 3 * TERMS)  # type, colour space, and planes: six for each colour
_LUMINANCE = (POLYNOMIAL_TYPE, "lrgb", 3 + TERMS)  # a colour, and six of the luminance that scales it
_ADVICE = "export it again as a PTM of RGB or LRGB coefficients (18 or 9 planes, in JPEG)"

Plane = Float32[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class PolynomialTexture:
    """Six coefficients a texel, of a polynomial that gives the picture's sRGB code / 255.

    Decoded, it is the radiance relative to that of a white Lambertian which the light meets head-on: times the
    irradiance across the light's beam / pi. Row 0 is the top; lu and lv are the light's direction along the picture's
    right and upward edges.
    """

    coefficients: Float16[np.ndarray, "6 h w 3"]
    f0: ClassVar[float] = 0.0  # it has no coat
    roughness: ClassVar[float] = 1.0

    @property
    def planes(self) -> Float16[np.ndarray, "6 h w 3"]:
        """What the GPU holds as textures that follow each other."""
        return self.coefficients

    def under(self, light: Float64[np.ndarray, "3"]) -> Float32[np.ndarray, "h w 3"]:
        """Returns what a lamp in a unit direction (right, up, towards the viewer) shows, relative to that white."""
        terms = polynomial_terms(light[None])[0].astype(np.float32)
        codes = np.clip(np.tensordot(terms, self.coefficients.astype(np.float32), 1), 0, 1)
        return np.asarray(decode_lut(None)[np.rint(255 * codes).astype(np.uint8), 0])

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
    """Reads a PTM in the web format of Relight: `info.json`, and `plane_0.jpg` to `plane_5.jpg` of RGB coefficients.

    Of LRGB coefficients, `plane_0.jpg` holds the colours, and `plane_1.jpg` and `plane_2.jpg` three terms each.

    Raises:
        DeltalightError: a file is missing or damaged, or it is another kind of map.
    """
    info = read_info(folder, "a PTM")
    kind = (info.get("type"), info.get("colorspace"), info.get("nplanes"))
    is_separate = kind == _SEPARATE
    if not is_separate and kind != _LUMINANCE:
        raise DeltalightError(
            f"{folder}/{INFO_NAME} describes no PTM of RGB or LRGB coefficients; {_ADVICE}."
        )
    read, count = (_separate_terms, 3 * TERMS) if is_separate else (_luminance_terms, 3 + TERMS)
    try:
        scale, bias = (
            finite_array(info["materials"][0][key]).astype(np.float32).reshape(count)
            for key in ("scale", "bias")
        )
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise DeltalightError(f"{folder}/{INFO_NAME} lacks whole scales and biases; {_ADVICE}.") from error
    planes = read(_pictures(folder, count // 3), scale, bias)
    return PolynomialTexture(
        np.stack([averaged(plane, MOST_TEXELS_EDGE).astype(np.float16) for plane in planes])
    )


def _pictures(folder: Path, count: int) -> Iterator[Plane]:
    """Yields the codes / 255 of all planes, which have one size."""
    shapes = set()
    for number in range(count):
        codes = read_codes(folder / f"plane_{number}.jpg")
        shapes.add(codes.shape)
        if len(shapes) > 1:
            raise DeltalightError(f"the planes of {folder} have several sizes; {_ADVICE}.")
        yield codes / np.float32(255)


def _separate_terms(
    pictures: Iterator[Plane], scale: Float32[np.ndarray, "18"], bias: Float32[np.ndarray, "18"]
) -> Iterator[Plane]:
    for picture, by, off in zip(pictures, scale.reshape(TERMS, 3), bias.reshape(TERMS, 3), strict=True):
        yield (picture - off) * by


def _luminance_terms(
    pictures: Iterator[Plane], scale: Float32[np.ndarray, "9"], bias: Float32[np.ndarray, "9"]
) -> Iterator[Plane]:
    """Yields coefficients of R, G and B: those of luminance times the colours, which have no scale of their own."""
    colors = next(pictures)
    for picture, by, off in zip(pictures, scale.reshape(3, 3)[1:], bias.reshape(3, 3)[1:], strict=True):
        terms = (picture - off) * by
        yield from (terms[..., channel, None] * colors for channel in range(3))
