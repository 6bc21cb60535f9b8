"""A virtual camera of Linux: pictures written to a device of v4l2loopback, which other programs read.

The kernel module is addressed by ioctl alone, without a library of another licence. Structures and numbers are those
of <linux/videodev2.h> (Video for Linux API, sections "ioctl VIDIOC_QUERYCAP" and "ioctl VIDIOC_G_FMT, VIDIOC_S_FMT").
"""

import errno
import fcntl
import os
import struct
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from jaxtyping import UInt8

from deltalight.protocol.errors import DeltalightError

# struct v4l2_capability: driver, card, bus_info, version, capabilities, device_caps, reserved.
CAPABILITY = struct.Struct("=16s32s32sIII3I")
# struct v4l2_format: type, padding, then struct v4l2_pix_format in a union of 200 bytes.
PIX_FORMAT = struct.Struct("=12I")
FORMAT_BYTES, PIX_OFFSET = 208, 8
_WRITE, _READ = 1, 2
DEVICE_CAPS, VIDEO_OUTPUT = 0x80000000, 0x00000002
BUF_TYPE_VIDEO_OUTPUT, FIELD_NONE = 2, 1
COLORSPACE_SRGB, YCBCR_601, LIMITED_RANGE = 8, 1, 2
YUYV = int.from_bytes(b"YUYV", "little")
ADVICE = (
    "load it with `sudo modprobe v4l2loopback exclusive_caps=1 card_label=Deltalight` and name its device"
)


def _ioctl_number(direction: int, number: int, size: int) -> int:
    """Returns the request of _IOR or _IOWR of group V (<asm-generic/ioctl.h>)."""
    return direction << 30 | size << 16 | ord("V") << 8 | number


QUERYCAP = _ioctl_number(_READ, 0, CAPABILITY.size)
S_FMT = _ioctl_number(_READ | _WRITE, 5, FORMAT_BYTES)


class VirtualCamera:
    """An open device that shows what is written to it; use it as a context manager.

    Args:
        path: the device, such as /dev/video10.

    Raises:
        DeltalightError: there is no such device, or it takes no pictures.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.size = path, (0, 0)
        try:
            self._file = os.open(path, os.O_RDWR)
        except OSError as fault:
            raise DeltalightError(_why_closed(path, fault)) from fault
        try:
            self._require_output()
        except BaseException:
            os.close(self._file)
            raise

    def __enter__(self) -> Self:
        """Returns the camera."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes the device."""
        os.close(self._file)

    def begin(self, size: tuple[int, int]) -> None:
        """Sets the width and height, rounded down to even ones, into which pictures are scaled.

        Raises:
            DeltalightError: another program writes to the device, or it wants another format.
        """
        self.size = width, height = size[0] & ~1, size[1] & ~1
        wanted = (width, height, YUYV, FIELD_NONE, 2 * width, 2 * width * height)
        data = bytearray(FORMAT_BYTES)
        struct.pack_into("=I", data, 0, BUF_TYPE_VIDEO_OUTPUT)
        rest = (COLORSPACE_SRGB, 0, 0, YCBCR_601, LIMITED_RANGE, 0)
        PIX_FORMAT.pack_into(data, PIX_OFFSET, *wanted, *rest)
        self._ioctl(S_FMT, data)
        if PIX_FORMAT.unpack_from(data, PIX_OFFSET)[:3] != wanted[:3]:  # drivers answer with what they take
            raise DeltalightError(
                f"{self.path} refuses {width}x{height} pixels (YUYV), because a program reads it in another format;"
                " stop that program or choose its size with --size."
            )

    def show(self, picture: UInt8[np.ndarray, "h w 3"]) -> None:
        """Writes an sRGB picture.

        Raises:
            DeltalightError: the device refuses it.
        """
        data = yuyv(fitted(picture, self.size))
        try:
            written = os.write(self._file, data)
        except OSError as fault:
            raise DeltalightError(f"{self.path} takes no more pictures ({fault.strerror}).") from fault
        if written != len(data):
            raise DeltalightError(f"{self.path} took {written} of {len(data)} bytes; reload v4l2loopback.")

    def _require_output(self) -> None:
        answer = bytearray(CAPABILITY.size)
        self._ioctl(QUERYCAP, answer)
        *_, capabilities, device_caps, _, _, _ = CAPABILITY.unpack(answer)
        able = device_caps if capabilities & DEVICE_CAPS else capabilities
        if not able & VIDEO_OUTPUT:
            raise DeltalightError(
                f"{self.path} is a camera that gives pictures and takes none; a virtual one is made by the kernel"
                f" module v4l2loopback: {ADVICE}."
            )

    def _ioctl(self, request: int, data: bytearray) -> None:
        try:
            fcntl.ioctl(self._file, request, data)
        except OSError as fault:
            if fault.errno == errno.EBUSY:
                raise DeltalightError(f"Another program writes to {self.path}; stop it.") from fault
            raise DeltalightError(
                f"{self.path} is not a virtual camera ({fault.strerror}); {ADVICE}."
            ) from fault


def _why_closed(path: Path, fault: OSError) -> str:
    if fault.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return f"There is no {path}: virtual cameras need the kernel module v4l2loopback; {ADVICE}."
    if fault.errno in (errno.EACCES, errno.EPERM):
        return f"{path} may not be written; add yourself to its group with `sudo usermod -aG video $USER`."
    return f"{path} cannot be opened ({fault.strerror}); {ADVICE}."


def fitted(picture: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Scales a picture into a size, with black beside it where the shapes differ."""
    width, height = size
    scale = min(width / picture.shape[1], height / picture.shape[0])
    inner = max(round(picture.shape[1] * scale), 1), max(round(picture.shape[0] * scale), 1)
    if inner != (picture.shape[1], picture.shape[0]):
        method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        picture = np.asarray(cv2.resize(picture, inner, interpolation=method))
    if inner == size:
        return picture
    placed = np.zeros((height, width, 3), np.uint8)
    top, left = (height - inner[1]) // 2, (width - inner[0]) // 2
    placed[top : top + inner[1], left : left + inner[0]] = picture
    return placed


def yuyv(picture: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """Returns the picture as YUYV 4:2:2: BT.601, limited range, which programs assume of webcams."""
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2YUV_YUYV)).tobytes()
