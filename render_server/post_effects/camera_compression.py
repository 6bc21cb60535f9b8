"""JPEG compression of the camera's picture, found in its pixels, and put on the virtual part of a picture.

A picture that was compressed hardly changes when it is compressed once more with the same table (Farid 2009, JPEG
ghosts), whereas the next finer tables change it more. Tables are those of ITU-T T.81, annex K, scaled as in libjpeg.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from deltalight.protocol.frames import ViewFrame

QUALITIES = range(30, 97)
"""Finer tables change less than the rounding of R G B."""
FINER = 2
"""How many of the next finer tables a quality is compared with."""
MOST_RESIDUAL = 0.5
"""Of what the finer tables change. Pictures that never were compressed have 0.8 and more."""
ROUNDED = 1e-3
"""Mean square change, in codes, that tells nothing."""
ROUNDING_STEPS = 6.0
"""Third differences of chroma that rounding of R G B does not explain, in codes (3 standard deviations)."""
LEAST_STEEP = 64
"""With fewer of them chroma is too smooth to tell, and too smooth for it to matter."""
MOST_UNEVEN = 0.25
"""Number of such differences across interpolated samples, over that of the others."""
BLOCK_PX = 16
"""Side of the largest unit of blocks, with chroma halved along both axes."""
EXAMINED_PX = 256
TRANSFORM_PX = 8
"""Side of the block that is transformed."""
LEAST_BLOCKS, LEAST_DEVIATION = 32, 1.0
"""Flat blocks (standard deviation in codes) agree with many tables."""
MOST_EXAMINED = 4
"""Frames in which compression is looked for."""

Color = UInt8[np.ndarray, "h w 3"]
SAMPLING = {
    (False, False): cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    (True, False): cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    (False, True): cv2.IMWRITE_JPEG_SAMPLING_FACTOR_440,
    (True, True): cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
}
"""By whether chroma has half the columns and half the rows."""


@dataclass(frozen=True)
class Compression:
    """Quality (1 to 100, as libjpeg counts), and whether chroma has half the columns and half the rows."""

    quality: int
    halved: tuple[bool, bool]


def find_compression(color: Color) -> Compression | None:
    """Returns how a picture was compressed; None if it was not, or too finely to tell."""
    middle = tuple(max(length - EXAMINED_PX, 0) // 2 // BLOCK_PX * BLOCK_PX for length in color.shape[:2])
    part = color[middle[0] : middle[0] + EXAMINED_PX, middle[1] : middle[1] + EXAMINED_PX]
    luma = cv2.cvtColor(part, cv2.COLOR_RGB2GRAY)
    luma = luma[
        : luma.shape[0] // TRANSFORM_PX * TRANSFORM_PX, : luma.shape[1] // TRANSFORM_PX * TRANSFORM_PX
    ]
    uneven = _by_block(luma).std(axis=-1) >= LEAST_DEVIATION
    if np.count_nonzero(uneven) < LEAST_BLOCKS:
        return None
    change = np.array(
        [_change(luma, uneven, each) for each in range(QUALITIES[0], QUALITIES[-1] + FINER + 1)]
    )
    finer = np.min([change[step : step + len(QUALITIES)] for step in range(1, FINER + 1)], axis=0)
    ratio = (change[: len(QUALITIES)] + ROUNDED) / (finer + ROUNDED)
    best = int(ratio.argmin())
    if ratio[best] > MOST_RESIDUAL:
        return None
    best -= int(change[max(best - FINER, 0) : best + 1][::-1].argmin())  # coarse tables hardly differ
    chroma = cv2.cvtColor(part.astype(np.float32), cv2.COLOR_RGB2YCrCb)[..., 1:]
    return Compression(QUALITIES[best], (_was_halved(chroma.swapaxes(0, 1)), _was_halved(chroma)))


def _by_block(plane: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "n m k"]:
    """Returns the pixels of each block that is transformed, by row and column of blocks."""
    rows, columns = (length // TRANSFORM_PX for length in plane.shape)
    blocks = plane.reshape(rows, TRANSFORM_PX, columns, TRANSFORM_PX).swapaxes(1, 2)
    return blocks.reshape(rows, columns, -1).astype(np.float32)


def _change(luma: UInt8[np.ndarray, "h w"], where: Bool[np.ndarray, "n m"], quality: int) -> float:
    """Returns the mean square by which compression changes some blocks of a plane."""
    again = _through_jpeg(luma, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return float(np.mean((_by_block(again)[where] - _by_block(luma)[where]) ** 2))


def _was_halved(chroma: Float32[np.ndarray, "h w 2"]) -> bool:
    """Tells whether chroma was interpolated from half the rows, with the weights 3/4 and 1/4 of libjpeg's decoder.

    Then x[2i-1] - 3 x[2i] + 3 x[2i+1] - x[2i+2] is 0.
    """
    steep = np.abs(np.diff(chroma, n=3, axis=0)) > ROUNDING_STEPS
    interpolated, other = (int(np.count_nonzero(steep[start::2])) for start in (1, 0))
    return other >= LEAST_STEEP and interpolated < MOST_UNEVEN * other


def _through_jpeg(picture: UInt8[np.ndarray, "..."], options: list[int]) -> UInt8[np.ndarray, "..."]:
    _, code = cv2.imencode(".jpg", picture, options)
    return np.asarray(cv2.imdecode(code, cv2.IMREAD_UNCHANGED), np.uint8)


def compressed(color: Color, coverage: Float32[np.ndarray, "h w"], compression: Compression) -> Color:
    """Returns a picture whose virtual part was compressed with what is around it, on the picture's grid of blocks.

    Pixels that objects do not cover are the same to the bit: they were compressed by the camera.
    """
    rows, columns = np.nonzero(coverage > 0)
    if not len(rows):
        return color
    box = tuple(
        slice(int(each.min()) // BLOCK_PX * BLOCK_PX, (int(each.max()) // BLOCK_PX + 1) * BLOCK_PX)
        for each in (rows, columns)
    )
    options = [cv2.IMWRITE_JPEG_QUALITY, compression.quality]
    options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, SAMPLING[compression.halved]]
    bgr = cv2.cvtColor(color[box], cv2.COLOR_RGB2BGR)
    again = cv2.cvtColor(_through_jpeg(bgr, options), cv2.COLOR_BGR2RGB)
    result = color.copy()
    result[box] = np.where(coverage[box][..., None] > 0, again, color[box])
    return result


class CameraCompression:
    """Learns from its first frames how a camera compresses."""

    def __init__(self) -> None:
        self._found: list[Compression | None] = []

    def observe(self, frame: ViewFrame) -> None:
        """Looks at a frame, until enough were seen."""
        if len(self._found) < MOST_EXAMINED:
            self._found.append(find_compression(frame.color))

    @property
    def model(self) -> Compression | None:
        """What all frames show, chroma halved if it is in any; None before, or if they differ."""
        found = [each for each in self._found if each is not None]
        if not found or len(found) < len(self._found) or len({each.quality for each in found}) > 1:
            return None
        columns, rows = (any(each.halved[axis] for each in found) for axis in (0, 1))
        return Compression(found[0].quality, (columns, rows))
