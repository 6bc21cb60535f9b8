"""Picture files and bytes of datasets and recordings: RGB colour, 16-bit depth and its steps."""

import math
import struct
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.codecs import stated_jpeg_size
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage

TUM_DEPTH_SCALE = 1 / 5000
KNOWN_DEPTH_SCALES = (0.001, TUM_DEPTH_SCALE, 0.0001, 0.00025)
INVALID_CODES = (0, 65535)
_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_CHUNK = struct.Struct(">I4s")  # length and kind; then the content and four bytes of checksum
_PNG_HEAD = struct.Struct(">IIBBBBB")  # width, height, bits a channel, colour type and three more
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type
_MOST_PER_BYTE = 1040  # deflate packs 1032 bytes into one at most, JPEG fewer
_COLOR = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


def is_jpeg(data: bytes) -> bool:
    """Whether the bytes begin like a JPEG."""
    return data[:3] == b"\xff\xd8\xff"


def read_bytes(path: Path) -> bytes:
    """Reads a picture file.

    Raises:
        DeltalightError: the file is missing or unreadable.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise DeltalightError(f"the picture {path} cannot be read ({error.strerror}); restore it.") from error


def decode_rgb(data: bytes, name: str) -> UInt8[np.ndarray, "h w 3"]:
    """Decodes a picture file's bytes to RGB; `name` names the picture in errors.

    Raises:
        DeltalightError: OpenCV cannot read the bytes as a picture.
    """
    picture = _decode(data, _COLOR)
    if picture is None:
        raise DeltalightError(f"the picture {name} cannot be decoded; replace it by a PNG or JPEG file.")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))


def decode_depth_png(data: bytes, name: str) -> UInt16[np.ndarray, "h w"]:
    """Decodes a 16-bit depth picture.

    Raises:
        DeltalightError: the bytes are damaged, or not a 16-bit picture of one channel.
    """
    picture = _decode(data, cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise DeltalightError(f"the depth picture {name} cannot be decoded; replace it by a 16-bit PNG file.")
    if picture.ndim != 2 or picture.dtype != np.uint16:
        raise DeltalightError(
            f"the depth picture {name} is not a 16-bit PNG of one channel; convert it to one."
        )
    return picture


def _decode(data: bytes, flags: int) -> np.ndarray | None:
    """Decodes a PNG or JPEG; None for others, and for those that state more than their bytes can hold."""
    if _stated_bytes(data) > _MOST_PER_BYTE * len(data):
        return None
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        return None
    return None if picture is None else np.asarray(picture)


def _stated_bytes(data: bytes) -> float:
    """Returns what a picture would take unpacked, by what it states; infinite if it is none, or not whole."""
    if data.startswith(_PNG):
        return _stated_png_bytes(data)
    size = stated_jpeg_size(data) if is_jpeg(data) else None
    return math.inf if size is None else 3.0 * size[0] * size[1]


def _stated_png_bytes(data: bytes) -> float:
    """As `_stated_bytes`; OpenCV also allocates by the length of each chunk, before it looks what is there."""
    place, stated = len(_PNG), math.inf
    while place + _PNG_CHUNK.size <= len(data):
        length, kind = _PNG_CHUNK.unpack_from(data, place)
        if kind == b"acTL" or place + _PNG_CHUNK.size + length > len(data):  # animated, or cut off
            return math.inf
        if kind == b"IHDR" and length == _PNG_HEAD.size:
            width, height, depth, colors, *_ = _PNG_HEAD.unpack_from(data, place + _PNG_CHUNK.size)
            stated = width * height * depth * _PNG_CHANNELS.get(colors, math.inf) / 8
        place += _PNG_CHUNK.size + length + 4
    return stated


def encode_png(picture: np.ndarray) -> bytes:
    """Encodes an RGB (h, w, 3) or 16-bit (h, w) picture as PNG, without loss."""
    stored = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR) if picture.ndim == 3 else picture
    # Level 1 is four times faster than the default and costs a tenth in size.
    return bytes(cv2.imencode(".png", stored, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])


def depth_from_steps(
    steps: UInt16[np.ndarray, "h w"], scale: float, camera: CameraModel, noise_sigma_m: float | None
) -> DepthImage:
    """Returns the depth image of stored steps of `scale` metres; 0 and 65535 are unknown."""
    valid = (steps != INVALID_CODES[0]) & (steps != INVALID_CODES[1])
    depth_m = np.where(valid, steps.astype(np.float32) * np.float32(scale), np.float32(0))
    return DepthImage(depth_m, valid, camera, noise_sigma_m)


def steps_from_depth(depth: DepthImage, scale: float) -> UInt16[np.ndarray, "h w"]:
    """Rounds depth to steps of `scale` metres; unknown depth, or too far for 16 bits, becomes 0."""
    with np.errstate(invalid="ignore"):
        steps = np.rint(depth.depth_m / np.float32(scale))
        known = depth.valid & (steps > INVALID_CODES[0]) & (steps < INVALID_CODES[1])
    return np.where(known, steps, 0).astype(np.uint16)


def exact_depth_scale(depth: DepthImage, hint: float | None) -> float | None:
    """Returns a step (metres) that stores the depth without loss: the hint, a usual one, or None."""
    for scale in (hint, *KNOWN_DEPTH_SCALES):
        if scale is not None and _is_exact(depth, scale):
            return scale
    return None


def _is_exact(depth: DepthImage, scale: float) -> bool:
    stored = depth_from_steps(steps_from_depth(depth, scale), scale, depth.camera, None)
    return np.array_equal(stored.valid, depth.valid) and np.array_equal(stored.depth_m, known_depth(depth))


def known_depth(depth: DepthImage) -> Float32[np.ndarray, "h w"]:
    """Returns the depth in metres, 0 where the mask says unknown."""
    return np.where(depth.valid, depth.depth_m, np.float32(0)).astype(np.float32)
