"""Files of Hewlett-Packard's `.ptm` format, version 1.2 (Malzbender and Gelb 2001), without compression."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.scene.polynomial_texture import (
    MOST_TEXELS_EDGE,
    TERMS,
    PolynomialTexture,
)
from deltalight.render_server.scene.texture_folder import LARGEST_PICTURE_PIXELS, averaged, finite_array

PTM_SUFFIX = ".ptm"
_VERSION = b"PTM_1.2"
_SEPARATE = b"PTM_FORMAT_RGB"  # six coefficients for each colour
_LUMINANCE = b"PTM_FORMAT_LRGB"  # six of luminance, and a colour that they scale
_TEXEL_BYTES = {_SEPARATE: 3 * TERMS, _LUMINANCE: TERMS + 3}
_LARGEST_BYTES = 3 * TERMS * LARGEST_PICTURE_PIXELS + 4096
_HEADER_NUMBERS = 2 + 2 * TERMS  # width and height, scales, biases
_ORDER = [5, 3, 4, 0, 2, 1]  # its lu^2, lv^2, lu lv, lu, lv, 1 as ours
_ADVICE = "save it again as PTM_1.2 in PTM_FORMAT_LRGB or PTM_FORMAT_RGB"


@dataclass(frozen=True, eq=False)
class _PtmFile:
    """What a file holds: rows from the bottom to the top. A coefficient is (byte - bias) scale."""

    width: int
    height: int
    scale: Float64[np.ndarray, "6"]
    bias: Float64[np.ndarray, "6"]
    data: UInt8[np.ndarray, " n"]

    def coefficient(self, block: int, term: int) -> Float32[np.ndarray, "h w"]:
        """Returns a coefficient of a block of polynomials, which give codes / 255; terms are ours."""
        size, stored = self.width * self.height * TERMS, _ORDER[term]
        coded = self.data[block * size + stored : (block + 1) * size : TERMS]
        decoded = (coded.astype(np.float32) - self.bias[stored]) * (self.scale[stored] / 255)
        return np.asarray(decoded.reshape(self.height, self.width)[::-1], np.float32)

    @cached_property
    def colors(self) -> Float32[np.ndarray, "h w 3"]:
        """The colours that end a file of luminances, as codes / 255."""
        coded = self.data[-self.width * self.height * 3 :].reshape(self.height, self.width, 3)
        return np.asarray(coded[::-1] / np.float32(255), np.float32)

    def planes(self, kind: bytes) -> Iterator[Float32[np.ndarray, "h w 3"]]:
        """Yields the coefficients of R, G, and B, term by term."""
        for term in range(TERMS):
            if kind == _SEPARATE:
                yield np.stack([self.coefficient(block, term) for block in range(3)], axis=-1)
            else:
                yield self.coefficient(0, term)[..., None] * self.colors


def read_ptm(path: Path) -> PolynomialTexture:
    """Reads a polynomial texture map from a `.ptm` file, of RGB or LRGB coefficients.

    A map larger than MOST_TEXELS_EDGE is averaged down.

    Raises:
        DeltalightError: it cannot be read, is damaged, or is of another kind.
    """
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise DeltalightError(f"{path} has more than {LARGEST_PICTURE_PIXELS} texels; reduce it first.")
        content = path.read_bytes()
    except OSError as error:
        raise DeltalightError(f"{path} cannot be read ({error.strerror}); give another file.") from error
    version, _, rest = content.partition(b"\n")
    kind, _, rest = rest.partition(b"\n")
    kind = kind.strip()
    if version.strip() != _VERSION or kind not in _TEXEL_BYTES:
        raise DeltalightError(f"{path} is not an uncompressed PTM of RGB or LRGB coefficients; {_ADVICE}.")
    file = _parsed(path, rest, _TEXEL_BYTES[kind])
    with np.errstate(over="ignore"):  # beyond float16: refused next
        planes = [averaged(plane, MOST_TEXELS_EDGE).astype(np.float16) for plane in file.planes(kind)]
    if not np.isfinite(planes).all():
        raise DeltalightError(f"{path} has coefficients beyond 65504 times white; {_ADVICE}.")
    return PolynomialTexture(np.stack(planes))


def _parsed(path: Path, rest: bytes, texel_bytes: int) -> _PtmFile:
    """Returns what follows the format's name.

    Raises:
        DeltalightError: its numbers are none, or its length is not that of its size.
    """
    try:
        *words, data = rest.split(maxsplit=_HEADER_NUMBERS - 1)
        last, _, data = data.partition(b"\n")  # bytes may be white space, so only the line's end is
        numbers = finite_array([float(word) for word in (*words, last)])
        width, height = (int(word) for word in words[:2])
    except ValueError as error:
        raise DeltalightError(f"{path} lacks its size, scales or biases; {_ADVICE}.") from error
    if len(numbers) != _HEADER_NUMBERS or not 0 < width * height <= LARGEST_PICTURE_PIXELS or width < 0:
        raise DeltalightError(f"{path} lacks its size, scales or biases; {_ADVICE}.")
    if len(data) != width * height * texel_bytes:
        raise DeltalightError(
            f"{path} has {len(data)} bytes of {width}x{height} texels, not {width * height * texel_bytes};"
            " it is damaged, so copy it again."
        )
    return _PtmFile(
        width, height, numbers[2 : 2 + TERMS], numbers[2 + TERMS :], np.frombuffer(data, np.uint8)
    )
