"""Photographs and range images of a folder of real pairs, read with faults in one sentence."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from deltalight.benchmarks.quality.metrics import Picture
from deltalight.benchmarks.quality.regions import Linear
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import decode_lut


def read_color(path: Path, size: tuple[int, int] | None = None) -> Picture:
    """Returns a photograph as RGB; `size` (width, height) is what it must have, if given.

    Raises:
        DeltalightError: it is missing, no picture, or of another size.
    """
    found = _read(path, cv2.IMREAD_COLOR)
    _require_size(path, found, size)
    return np.asarray(cv2.cvtColor(found, cv2.COLOR_BGR2RGB), np.uint8)


def read_values(path: Path, size: tuple[int, int]) -> Float64[np.ndarray, "h w"]:
    """Returns an image of one channel, such as depth, in the file's own unit; not finite = 0.

    Raises:
        DeltalightError: it is missing, has more channels, or is of another size.
    """
    found = _read(path, cv2.IMREAD_UNCHANGED)
    if found.ndim != 2:
        raise DeltalightError(
            f"{path} has {found.shape[2]} channels where depth has one; give the original file."
        )
    _require_size(path, found, size)
    return np.nan_to_num(found.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)


def _read(path: Path, flags: int) -> Float64[np.ndarray, "..."]:
    if not path.is_file():
        raise DeltalightError(f"{path} does not exist; --data must name the folder of real pairs.")
    found = cv2.imread(str(path), flags)
    if found is None:
        raise DeltalightError(f"{path} cannot be read as a picture; copy the folder of real pairs again.")
    return np.asarray(found)


def _require_size(path: Path, found: Float64[np.ndarray, "..."], size: tuple[int, int] | None) -> None:
    if size is not None and found.shape[1::-1] != size:
        have, need = ("x".join(map(str, each)) for each in (found.shape[1::-1], size))
        raise DeltalightError(f"{path} has {have} pixels where {need} are needed; give pictures of one size.")


def linear(color: Picture) -> Linear:
    """Returns a photograph in linear units, by the sRGB response: the cameras' own are not known."""
    lut: Float32[np.ndarray, "256 3"] = decode_lut(None)
    return np.asarray(lut[color, np.arange(3)], np.float32)
