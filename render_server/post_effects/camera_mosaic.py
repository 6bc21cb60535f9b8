"""A camera's colour mosaic, found in its pictures, and put on the virtual part of a picture.

Behind a mosaic of filters (Bayer 1976) a sensor measures one colour at each pixel; demosaicking interpolates the
others from neighbours. Here that is bilinear, in linear light and by channel. A picture that was made so hardly
changes when it is sampled by the same mosaic and interpolated once more, whereas other phases of the mosaic change
it: interpolated pixels lack noise and detail (Popescu & Farid 2005; Gallagher & Chen 2008). Interpolation that is
near bilinear is found as well, and taken for it; one that is far from it is not, nor is a picture that was scaled or
compressed.
"""

from functools import cache
from typing import Literal, get_args

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from deltalight.protocol.frames import ViewFrame, decode_lut

Mosaic = Literal["RGGB", "BGGR", "GRBG", "GBRG"]
"""Colours of a block of 2x2 pixels, row by row, the picture's first pixel first."""
MOSAICS: tuple[Mosaic, ...] = get_args(Mosaic)
COLORED = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4
"""Interpolates red and blue, which one pixel in four measures."""
GREEN = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4
KERNELS = (COLORED, GREEN, COLORED)
NOISE_KEPT = np.array([9, 10, 9]) / 16
"""Fraction of independent noise's variance left by interpolation, R G B: the mean of the phases' sums of squares."""
GREEN_VARIANCE = 1 / 4
"""Of green's blur by interpolation, along rows and along columns, px^2: 1/2 in half of the pixels, none in others."""
EXAMINED_PX = 256
BLOCK_PX = 16
LEAST_BLOCKS, LEAST_CHANGE = 32, 0.5
"""Blocks, and the mean square in codes by which other phases must change them: flat ones agree with all phases."""
MOST_RESIDUAL = 0.5
"""Of the change by the next phase. Pictures without a mosaic have 0.9 and more."""
ROUNDED = 1e-3
"""Mean square change, in codes, that tells nothing."""
SIGNIFICANT = 3.0
"""Standard errors by which the blocks' mean must be below no difference."""
MOST_EXAMINED = 4
"""Frames in which a mosaic is looked for."""

Color = UInt8[np.ndarray, "h w 3"]
Coverage = Float32[np.ndarray, "h w"]


@cache
def _measured(mosaic: Mosaic) -> Bool[np.ndarray, "2 2 3"]:
    """Returns where in a block each of R G B is measured."""
    return np.array([[[name == each for each in "RGB"] for name in row] for row in (mosaic[:2], mosaic[2:])])


def demosaicked(picture: Float32[np.ndarray, "h w c"], mosaic: Mosaic) -> Float32[np.ndarray, "h w c"]:
    """Returns R G B as interpolated from what the mosaic measures of them; the first pixel is a block's first."""
    height, width = picture.shape[:2]
    blocks = (height + 1) // 2, (width + 1) // 2, 1
    samples = picture * np.tile(_measured(mosaic), blocks)[:height, :width]
    channels = [
        # Reflected about the outermost pixels, the mosaic goes on beyond them.
        cv2.filter2D(samples[..., channel], -1, kernel, borderType=cv2.BORDER_REFLECT_101)
        for channel, kernel in enumerate(KERNELS)
    ]
    return np.stack(channels, axis=-1)


def find_mosaic(color: Color, response: Float32[np.ndarray, "256 3"] | None) -> Mosaic | None:
    """Returns the mosaic that a picture was interpolated from; None if that is not sure."""
    middle = tuple(max(length - EXAMINED_PX, 0) // 4 * 2 for length in color.shape[:2])
    part = color[middle[0] : middle[0] + EXAMINED_PX, middle[1] : middle[1] + EXAMINED_PX]
    changes = np.stack([_changes(part, each, response) for each in MOSAICS])
    best = int(changes.mean(axis=1).argmin())
    others = np.delete(changes, best, axis=0)
    following = others[others.mean(axis=1).argmin()]
    telling = following >= LEAST_CHANGE
    if np.count_nonzero(telling) < LEAST_BLOCKS:
        return None
    log_ratio = np.log((changes[best] + ROUNDED) / (following + ROUNDED))[telling]
    error = log_ratio.std(ddof=1) / np.sqrt(len(log_ratio))
    is_sure = log_ratio.mean() < min(np.log(MOST_RESIDUAL), -SIGNIFICANT * error)
    return MOSAICS[best] if is_sure else None


def _changes(
    color: Color, mosaic: Mosaic, response: Float32[np.ndarray, "256 3"] | None
) -> Float64[np.ndarray, " n"]:
    """Returns the mean square, in codes, by which sampling and interpolation change each block of a picture."""
    again = _coded(demosaicked(_linear(color, response), mosaic), response)
    square = ((again - color) ** 2).mean(axis=-1)
    rows, columns = (length // BLOCK_PX for length in square.shape)
    blocks = square[: rows * BLOCK_PX, : columns * BLOCK_PX].reshape(rows, BLOCK_PX, columns, BLOCK_PX)
    return np.asarray(blocks.mean(axis=(1, 3)).ravel())


def _linear(color: Color, response: Float32[np.ndarray, "256 3"] | None) -> Float32[np.ndarray, "h w 3"]:
    return np.asarray(decode_lut(response)[color, np.arange(3)], np.float32)


def _coded(
    linear: Float32[np.ndarray, "h w 3"], response: Float32[np.ndarray, "256 3"] | None
) -> Float64[np.ndarray, "h w 3"]:
    """Returns codes, not yet rounded."""
    lut = decode_lut(response)
    return np.stack([np.interp(linear[..., c], lut[:, c], np.arange(256)) for c in range(3)], axis=-1)


def mosaicked(
    color: Color, coverage: Coverage, mosaic: Mosaic, response: Float32[np.ndarray, "256 3"] | None
) -> tuple[Color, Coverage]:
    """Returns a picture whose virtual part was measured through a mosaic, and how much that covers then.

    Beside objects, colours that are interpolated from pixels of theirs change as well. All others are the same to the
    bit: they were interpolated by the camera.
    """
    rows, columns = np.nonzero(coverage > 0)
    if not len(rows):
        return color, coverage
    # Whole blocks, with a pixel beside objects that changes and its neighbours.
    box = tuple(slice(max(int(each.min()) - 2, 0) // 2 * 2, int(each.max()) + 3) for each in (rows, columns))
    codes, cover = color[box], np.clip(coverage[box], 0, 1)
    reached = demosaicked(np.repeat(cover[..., None], 3, axis=-1), mosaic)
    again = _coded(demosaicked(_linear(codes, response), mosaic), response)
    result, covered = color.copy(), coverage.copy()
    result[box] = np.where((cover[..., None] > 0) | (reached > 0), np.rint(again), codes)
    covered[box] = np.maximum(coverage[box], reached.max(axis=-1))
    return result, covered


class CameraMosaic:
    """Learns from its first frames whether a camera interpolates from a mosaic."""

    def __init__(self) -> None:
        self._found: list[Mosaic | None] = []

    def observe(self, frame: ViewFrame) -> None:
        """Looks at a frame, until enough were seen."""
        if len(self._found) < MOST_EXAMINED:
            self._found.append(find_mosaic(frame.color, frame.response))

    @property
    def model(self) -> Mosaic | None:
        """What all frames show; None before, or if they differ."""
        return self._found[0] if len(set(self._found)) == 1 else None
