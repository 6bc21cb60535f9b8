"""Codecs of the raw parts: JPEG for pictures, blosc2 with bit shuffle for depth and maps (SPEC.md, section 4).

Colour is RGB in every signature. Decoders compare the size stated by the encoded data with the shape of the message
before they allocate a picture.
"""

import math
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Shaped, UInt8

from deltalight.protocol.envelope import Buffer, EnvelopeError
from deltalight.protocol.messages import RESPONSE_SHAPE, DType

DEFAULT_DEPTH_SCALE_M = 0.0002
JPEG_QUALITY = 90
_DEPTH_MAX = 65535
_BLOSC2_HEADER_BYTES = 32
_BLOSC2_MEMCPYED = 0x02
_BLOSC2_ZSTD = 4
_BLOSC2_FILTERS = (bytes(6), bytes([2, 0, 0, 0, 0, 0]))  # none, or bit shuffle alone
_BLOSC2_PLAIN, _BLOSC2_ZEROS = 0x00, 0x10
_JPEG_SIZE_MARKERS = (0xC0, 0xC1, 0xC2)
_JPEG_OTHER_FRAMES = (0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF)


def encode_color(
    pixels: UInt8[np.ndarray, "h w 3"], encoding: Literal["jpeg", "raw"] = "jpeg", quality: int = JPEG_QUALITY
) -> bytes:
    """Encodes a picture; `quality` (1 to 100) applies to jpeg only.

    Raises:
        EnvelopeError: not an 8-bit RGB picture.
    """
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0:
        raise EnvelopeError(f"a picture is height x width x 3 of uint8, not {pixels.shape} of {pixels.dtype}")
    if encoding == "raw":
        return pixels.tobytes()
    bgr = cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_RGB2BGR)
    done, code = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise EnvelopeError(f"OpenCV cannot write a jpeg of shape {pixels.shape}: send it raw")
    return bytes(code.tobytes())


def decode_color(
    part: Buffer, encoding: Literal["jpeg", "raw"], shape: tuple[int, int, int]
) -> UInt8[np.ndarray, "h w 3"]:
    """Decodes a part to an RGB picture; a raw part gives a read-only view.

    Raises:
        EnvelopeError: not a complete jpeg, or its size is not `shape`.
    """
    if encoding == "raw":
        return decode_raw(part, shape, "uint8")
    stated = jpeg_size(part)
    if stated != tuple(shape[:2]):
        raise EnvelopeError(f"the jpeg is {stated} and the header says {tuple(shape[:2])}: correct one")
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        bgr = cv2.imdecode(np.frombuffer(part, np.uint8), flags)
    except cv2.error as error:
        raise EnvelopeError(f"OpenCV cannot read the jpeg: {error.err}") from error
    if bgr is None or bgr.shape != tuple(shape) or bgr.dtype != np.uint8:
        raise EnvelopeError("the jpeg cannot be decoded: send a baseline or progressive one of 8 bits")
    rgb: UInt8[np.ndarray, "h w 3"] = cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)
    return rgb


def encode_depth(
    depth_m: Float32[np.ndarray, "h w"],
    valid: Bool[np.ndarray, "h w"],
    encoding: Literal["blosc2", "raw"] = "blosc2",
    depth_scale_m: float = DEFAULT_DEPTH_SCALE_M,
) -> bytes:
    """Encodes depth in steps of `depth_scale_m` metres.

    Pixels that are invalid, or do not fit 1..65535 steps, become unknown (0).

    Raises:
        EnvelopeError: not a depth image with a mask of its shape.
    """
    if depth_m.ndim != 2 or valid.shape != depth_m.shape or depth_m.size == 0:
        raise EnvelopeError(f"depth and mask are height x width, not {depth_m.shape} and {valid.shape}")
    with np.errstate(invalid="ignore", over="ignore"):
        steps = np.rint(depth_m / np.float32(depth_scale_m))
        known = valid.astype(bool) & (steps >= 1) & (steps <= _DEPTH_MAX)
    return encode_array(np.where(known, steps, 0).astype(np.uint16), encoding)


def decode_depth(
    part: Buffer, encoding: Literal["blosc2", "raw"], shape: tuple[int, int], depth_scale_m: float
) -> tuple[Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Decodes a part to depth in metres (0 where unknown) and its validity mask.

    Raises:
        EnvelopeError: not a blosc2 chunk as SPEC.md describes it, or its size is not `shape`.
    """
    steps = decode_array(part, encoding, shape, "uint16")
    return steps.astype(np.float32) * np.float32(depth_scale_m), steps > 0


def encode_array(values: Shaped[np.ndarray, "..."], encoding: Literal["blosc2", "raw"]) -> bytes:
    """Encodes an array of uint8, uint16 or float32, without loss."""
    stored = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
    return stored.tobytes() if encoding == "raw" else _compress(stored)


def decode_array(
    part: Buffer, encoding: Literal["blosc2", "raw"], shape: tuple[int, ...], dtype: DType
) -> Shaped[np.ndarray, "..."]:
    """Decodes a part to an array; a raw part gives a read-only view.

    Raises:
        EnvelopeError: not a blosc2 chunk as SPEC.md describes it, or its size is not `shape`.
    """
    return decode_raw(part, shape, dtype) if encoding == "raw" else _decompress(part, shape, dtype)


def decode_response(part: Buffer) -> Float32[np.ndarray, "256 3"]:
    """Decodes the camera response of a colour message: linear value of each 8-bit code and channel.

    Raises:
        EnvelopeError: its size is wrong, or values are negative or not finite.
    """
    response = decode_raw(part, RESPONSE_SHAPE, "float32")
    if not np.isfinite(response).all() or (response < 0).any():
        raise EnvelopeError("the camera response holds negative or non-finite values: send linear ones")
    return response


def decode_raw(part: Buffer, shape: tuple[int, ...], dtype: DType) -> Shaped[np.ndarray, "..."]:
    """Returns a read-only array view of an uncompressed part (little-endian, C order).

    Raises:
        EnvelopeError: its length is not that of `shape`.
    """
    kind = np.dtype(dtype).newbyteorder("<")
    view = memoryview(part)
    if view.nbytes != math.prod(shape) * kind.itemsize:
        raise EnvelopeError(
            f"{shape} of {dtype} does not take the {view.nbytes} bytes that came: correct one"
        )
    array = np.frombuffer(view, kind).reshape(shape)
    array.flags.writeable = False
    return array


def jpeg_size(part: Buffer) -> tuple[int, int]:
    """Returns height and width from the markers of a jpeg, without decoding it.

    Raises:
        EnvelopeError: not a complete 8-bit jpeg.
    """
    data = memoryview(part).cast("B")
    if bytes(data[:2]) != b"\xff\xd8" or not bytes(data[-256:]).rstrip(b"\0").endswith(b"\xff\xd9"):
        raise EnvelopeError("the picture is not a complete jpeg: send one from its first to its last marker")
    size = stated_jpeg_size(data)
    if size is None:
        raise EnvelopeError("the jpeg states no size: send a baseline or progressive one of 8 bits")
    return size


def stated_jpeg_size(part: Buffer) -> tuple[int, int] | None:
    """Returns height and width that the beginning of an 8-bit jpeg states; None if it states none."""
    data = memoryview(part).cast("B")
    place = 2
    while place + 9 <= len(data) and data[place] == 0xFF:
        marker, length = data[place + 1], int.from_bytes(data[place + 2 : place + 4], "big")
        if marker == 0xFF:  # fill byte
            place += 1
            continue
        if marker in _JPEG_SIZE_MARKERS and data[place + 4] == 8:
            return (
                int.from_bytes(data[place + 5 : place + 7], "big"),
                int.from_bytes(data[place + 7 : place + 9], "big"),
            )
        if marker in _JPEG_OTHER_FRAMES or marker < 0xC0 or 0xD0 <= marker <= 0xDA or length < 2:
            break
        place += 2 + length
    return None


def _compress(values: Shaped[np.ndarray, "..."]) -> bytes:
    import blosc2  # late, for processes that handle pictures alone: it takes a tenth of a second

    # One thread: a frame takes about 1 ms, and the cores belong to the renderer.
    code: bytes = blosc2.compress2(
        values,
        typesize=values.itemsize,
        codec=blosc2.Codec.ZSTD,
        clevel=1,
        filters=[blosc2.Filter.BITSHUFFLE],
        nthreads=1,
    )
    return code


def _decompress(part: Buffer, shape: tuple[int, ...], dtype: DType) -> Shaped[np.ndarray, "..."]:
    import blosc2

    data = memoryview(part).cast("B")
    values = np.dtype(dtype).newbyteorder("<")
    _check_chunk(data, math.prod(shape) * values.itemsize, values.itemsize)
    array = np.zeros(shape, values)
    try:
        blosc2.decompress2(data, dst=array, nthreads=1)
    except (ValueError, RuntimeError, TypeError) as error:
        raise EnvelopeError(f"the part is not a blosc2 chunk that can be read: {error}") from error
    return array


def _check_chunk(data: memoryview, expected: int, expected_item: int) -> None:
    """Refuses a chunk whose 32-byte header states a size, codec or filter that SPEC.md does not allow."""
    if len(data) < _BLOSC2_HEADER_BYTES:
        raise EnvelopeError(
            f"a blosc2 chunk has at least 32 bytes and the part has {len(data)}: send it whole"
        )
    flags, item_size = data[2], data[3]
    size, block, length = np.frombuffer(data[4:16], "<u4").tolist()
    if size != expected:
        raise EnvelopeError(f"the part unpacks to {size} bytes and its shape needs {expected}: correct one")
    if length != len(data):
        raise EnvelopeError(f"the part has {len(data)} bytes and states {length}: send it whole")
    known_codec = flags & _BLOSC2_MEMCPYED or flags >> 5 == _BLOSC2_ZSTD or data[31] == _BLOSC2_ZEROS
    known_filters = bytes(data[16:22]) in _BLOSC2_FILTERS and not any(data[24:31])
    known_kind = data[31] in (_BLOSC2_PLAIN, _BLOSC2_ZEROS) and 1 <= block <= max(size, 32)
    if not (known_codec and known_filters and known_kind and item_size == expected_item):
        raise EnvelopeError("the part is packed in another way than zstd with bit shuffle: use that")
