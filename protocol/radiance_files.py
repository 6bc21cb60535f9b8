"""Files of linear radiance: Radiance .hdr and OpenEXR."""

import errno
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32

from deltalight.protocol.errors import DeltalightError, install_command

LINEAR_SUFFIXES = (".hdr", ".exr")


def read_linear(path: Path) -> Float32[np.ndarray, "h w 3"]:
    """Reads a .hdr or .exr picture as linear R G B; negative values (lossy compression leaves some) become 0.

    Raises:
        DeltalightError: it cannot be read, holds values that are not finite, or is .exr and the package OpenEXR
            is not installed.
    """
    picture = _read_exr(path) if path.suffix.lower() == ".exr" else _read_hdr(path)
    if not np.isfinite(picture).all():
        raise DeltalightError(f"{path} holds values that are not finite; export it again.")
    return np.asarray(np.maximum(picture, 0))


def write_exr(
    path: Path,
    linear: Float32[np.ndarray, "h w c"],
    layers: Mapping[str, Float32[np.ndarray, "h w ..."]] | None = None,
) -> None:
    """Writes linear RGB or RGBA as an OpenEXR file of 32-bit floats, without loss.

    `layers` by name: further ones with R G B of their own, or with one value, such as `Z`.

    Raises:
        DeltalightError: the package OpenEXR is not installed.
        OSError: the file cannot be written.
    """
    exr = require_openexr(f"writing {path}")
    pictures = {"RGBA"[: linear.shape[2]]: linear, **(layers or {})}
    channels = {name: np.ascontiguousarray(values) for name, values in pictures.items()}
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    with exr.File(header, channels) as file:
        try:
            file.write(str(path))
        except RuntimeError as error:  # how the package reports a full disk
            raise OSError(errno.EIO, str(error).rstrip(". ")) from error


def require_openexr(purpose: str) -> ModuleType:
    """Returns the OpenEXR package; `purpose` begins the error sentence by naming what needs it.

    Raises:
        DeltalightError: it is not installed.
    """
    try:
        return import_module("OpenEXR")  # it has no type information
    except ImportError as error:
        raise DeltalightError(
            f"{purpose} needs the package OpenEXR: {install_command('OpenEXR')}."
        ) from error


def _read_hdr(path: Path) -> Float32[np.ndarray, "h w 3"]:
    try:
        picture: Any = cv2.imread(str(path), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR)
    except cv2.error:
        picture = None
    if picture is None or picture.dtype != np.float32:
        raise DeltalightError(f"{path} cannot be read as a Radiance .hdr picture; export it again.")
    return np.ascontiguousarray(picture[..., ::-1])


def _read_exr(path: Path) -> Float32[np.ndarray, "h w 3"]:
    exr = require_openexr(f"reading {path}")
    try:
        with exr.File(str(path)) as file:
            channels = file.channels()
            (stored,) = (channels[name].pixels for name in ("RGB", "RGBA") if name in channels)
    except Exception as error:  # the package does not document its exceptions
        raise DeltalightError(
            f"{path} cannot be read as an OpenEXR picture of R, G and B; export it again."
        ) from error
    return np.ascontiguousarray(stored[..., :3], np.float32)
