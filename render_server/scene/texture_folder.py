"""Folders that describe a texture by the light's direction: `info.json` and pictures."""

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8
from PIL import Image

from deltalight.protocol.errors import DeltalightError

INFO_NAME = "info.json"
_LARGEST_INFO_BYTES = 1 << 20
LARGEST_PICTURE_PIXELS = 64_000_000


def read_info(folder: Path, what: str) -> dict[str, Any]:
    """Reads the description in a folder; `what` it is, for messages.

    Raises:
        DeltalightError: it is missing, or no JSON object.
    """
    path = folder / INFO_NAME
    try:
        if path.stat().st_size > _LARGEST_INFO_BYTES:
            raise DeltalightError(f"{path} has more than 1 MB, which no description has.")
        info = json.loads(path.read_text())
    except OSError as error:
        raise DeltalightError(
            f"{path} cannot be read ({error.strerror}); {what} is a folder with it."
        ) from error
    except (ValueError, RecursionError) as error:
        raise DeltalightError(f"{path} is not a JSON document; {what} is a folder with one.") from error
    if not isinstance(info, dict):
        raise DeltalightError(f"{path} holds no JSON object; {what} is a folder with one.")
    return info


def finite_array(numbers: object) -> Float64[np.ndarray, "..."]:
    """Returns numbers as an array.

    Raises:
        ValueError: they are not all finite, or make no array.
        TypeError: they are no numbers.
    """
    try:
        array = np.array(numbers, np.float64)
    except OverflowError as error:
        raise ValueError from error
    if not np.isfinite(array).all():
        raise ValueError
    return array


def read_codes(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Reads a picture's codes.

    Raises:
        DeltalightError: it is no picture, or too large.
    """
    try:
        with Image.open(path) as image:
            if image.width * image.height > LARGEST_PICTURE_PIXELS:
                raise DeltalightError(f"{path} has {image.width}x{image.height} pixels, which is too many.")
            return np.asarray(image.convert("RGB"))
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DeltalightError(f"{path} cannot be read as a picture; export it again.") from error


def averaged(values: Float32[np.ndarray, "h w 3"], most_edge: int) -> Float32[np.ndarray, "k l 3"]:
    """Averages a picture down until no edge is longer than `most_edge`; smaller ones stay."""
    by = most_edge / max(values.shape[:2])
    if by >= 1:
        return values
    size = tuple(max(1, math.floor(edge * by + 0.5)) for edge in values.shape[1::-1])
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), np.float32)
