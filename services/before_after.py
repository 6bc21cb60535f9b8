"""Before and after in one moving picture: a line goes across, with the camera's picture on its left."""

import math
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from deltalight.services.video_file import video_file

WIDTH = 480
PICTURES = 24
PERIOD_MS = 80
REACH = 0.46  # of the width, to each side of the middle
LINE_PX = 2
ROUNDS = 3  # of a video, which players show once
COLORS = 192  # beside the line's white; GIF has 256


def divided(
    before: UInt8[np.ndarray, "h w 3"], after: UInt8[np.ndarray, "h w 3"], position: float
) -> UInt8[np.ndarray, "h w 3"]:
    """Returns `before` left of a white line at this fraction of the width, and `after` right of it."""
    column = round(position * before.shape[1])
    picture = after.copy()
    picture[:, :column] = before[:, :column]
    picture[:, max(column - LINE_PX // 2, 0) : column + LINE_PX // 2] = 255
    return picture


def before_after_gif(before: UInt8[np.ndarray, "h w 3"], after: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Returns a GIF that repeats for ever, in the size of `after` and at most WIDTH wide."""
    after = _small(after)
    before = _resized(before, (after.shape[1], after.shape[0]))
    # One palette, without dithering, lets pictures share what does not change: half the size.
    palette = _palette(np.vstack([before, after]))
    first, *rest = [
        Image.fromarray(each).quantize(palette=palette, dither=Image.Dither.NONE)
        for each in _round(before, after)
    ]
    file = BytesIO()
    first.save(file, "GIF", save_all=True, append_images=rest, duration=PERIOD_MS, loop=0, optimize=False)
    return file.getvalue()


def write_before_after_video(
    path: Path, before: UInt8[np.ndarray, "h w 3"], after: UInt8[np.ndarray, "h w 3"]
) -> None:
    """Writes the same as a video (H.264) of ROUNDS rounds, in the whole size of `after`.

    Raises:
        DeltalightError: PyAV is missing, the name is taken, or the disk refuses.
    """
    before = _resized(before, (after.shape[1], after.shape[0]))
    times_ns = [number * PERIOD_MS * 10**6 for number in range(ROUNDS * PICTURES)]
    with video_file(path, times_ns) as video:
        pictures = (each for _ in range(ROUNDS) for each in _round(before, after))
        for time_ns, picture in zip(times_ns, pictures, strict=True):
            video.add(picture, time_ns)


def _round(
    before: UInt8[np.ndarray, "h w 3"], after: UInt8[np.ndarray, "h w 3"]
) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    """Yields pictures in which the line goes there and back."""
    for step in range(PICTURES):
        yield divided(before, after, 0.5 + REACH * math.cos(2 * math.pi * step / PICTURES))


def _palette(picture: UInt8[np.ndarray, "h w 3"]) -> Image.Image:
    """Returns an image whose palette is that of a picture, and white."""
    colors = Image.fromarray(picture).quantize(COLORS, dither=Image.Dither.NONE).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([*colors[: 3 * COLORS], 255, 255, 255])
    return palette


def _small(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    height, width = picture.shape[:2]
    if width <= WIDTH:
        return picture
    return _resized(picture, (WIDTH, max(round(WIDTH * height / width), 1)))


def _resized(picture: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "h2 w2 3"]:
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
