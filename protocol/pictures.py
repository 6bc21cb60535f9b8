"""Picture files and bytes of datasets and recordings: RGB colour, 16-bit depth and its steps."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage

TUM_DEPTH_SCALE = 1 / 5000
KNOWN_DEPTH_SCALES = (0.001, TUM_DEPTH_SCALE, 0.0001, 0.00025)
INVALID_CODES = (0, 65535)
_COLOR = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


def is_jpeg(data: bytes) -> bool:
    """Whether the bytes begin like a JPEG."""
    return data[:3] == b"\xff\xd8\xff"


def read_bytes(path: Path) -> bytes:
    """Read a picture file.

    Raises:
        DeltalightError: the file is missing or unreadable.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise DeltalightError(f"the picture {path} cannot be read ({error.strerror}); restore it.") from error


def decode_rgb(data: bytes, name: str) -> UInt8[np.ndarray, "h w 3"]:
    """Decode a picture file's bytes to RGB; `name` names the picture in errors.

    Raises:
        DeltalightError: OpenCV cannot read the bytes as a picture.
    """
    picture = _decode(data, _COLOR)
    if picture is None:
        raise DeltalightError(f"the picture {name} cannot be decoded; replace it by a PNG or JPEG file.")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))


def decode_depth_png(data: bytes, name: str) -> UInt16[np.ndarray, "h w"]:
    """Decode a 16-bit depth picture.

    Raises:
        DeltalightError: the bytes are not a 16-bit picture of one channel.
    """
    picture = _decode(data, cv2.IMREAD_UNCHANGED)
    if picture is None or picture.ndim != 2 or picture.dtype != np.uint16:
        raise DeltalightError(
            f"the depth picture {name} is not a 16-bit PNG of one channel; convert it to one."
        )
    return picture


def _decode(data: bytes, flags: int) -> np.ndarray | None:
    try:
        return (
            np.asarray(picture)
            if (picture := cv2.imdecode(np.frombuffer(data, np.uint8), flags)) is not None
            else None
        )
    except cv2.error:
        return None


def encode_png(picture: np.ndarray) -> bytes:
    """Encode an RGB (h, w, 3) or 16-bit (h, w) picture as PNG, without loss."""
    stored = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) if picture.ndim == 3 else picture
    # Level 1 is four times faster than the default and costs a tenth in size.
    return bytes(cv2.imencode(".png", stored, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])


def depth_from_steps(
    steps: UInt16[np.ndarray, "h w"], scale: float, camera: CameraModel, noise_sigma_m: float | None
) -> DepthImage:
    """Return the depth image of stored steps of `scale` metres; 0 and 65535 are unknown."""
    valid = ~np.isin(steps, INVALID_CODES)
    depth_m = np.where(valid, steps.astype(np.float32) * np.float32(scale), np.float32(0))
    return DepthImage(depth_m, valid, camera, noise_sigma_m)


def steps_from_depth(depth: DepthImage, scale: float) -> UInt16[np.ndarray, "h w"]:
    """Round depth to steps of `scale` metres; unknown depth, or too far for 16 bits, becomes 0."""
    with np.errstate(invalid="ignore"):
        steps = np.rint(depth.depth_m / np.float32(scale))
        known = depth.valid & (steps > INVALID_CODES[0]) & (steps < INVALID_CODES[1])
    return np.where(known, steps, 0).astype(np.uint16)


def exact_depth_scale(depth: DepthImage, hint: float | None) -> float | None:
    """Return a step (metres) that stores the depth without loss: the hint, a usual one, or None."""
    for scale in (hint, *KNOWN_DEPTH_SCALES):
        if scale is not None and _is_exact(depth, scale):
            return scale
    return None


def _is_exact(depth: DepthImage, scale: float) -> bool:
    stored = depth_from_steps(steps_from_depth(depth, scale), scale, depth.camera, None)
    return np.array_equal(stored.valid, depth.valid) and np.array_equal(stored.depth_m, known_depth(depth))


def known_depth(depth: DepthImage) -> Float32[np.ndarray, "h w"]:
    """Return the depth in metres, 0 where the mask says unknown."""
    return np.where(depth.valid, depth.depth_m, np.float32(0)).astype(np.float32)
