"""H.264 of live pictures (extra `video`): one picture in, one access unit out at once, and the other way round.

Access units are byte streams (ITU-T H.264, Annex B) with parameter sets before each IDR picture: WebCodecs takes them
as they are. Colour is stated as it is: BT.709 primaries and matrix, sRGB transfer, codes 16 to 235 (ITU-T H.273).
"""

from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, cast

import numpy as np
from jaxtyping import UInt8

from deltalight.protocol.errors import DeltalightError, install_command

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext
    from av.video.frame import VideoFrame

SOFTWARE, NVENC = "libx264", "h264_nvenc"
NO_AV = f"H.264 needs the package av (PyAV): {install_command('av')}."
NO_ENCODER = f"The FFmpeg of this PyAV has no encoder {SOFTWARE}; install the wheel of the package av."
TICKS_PER_S = 90_000
USUAL_RATE = 30  # that encoders reckon with; pictures come when they come
NO_PERIOD = 1_000_000  # pictures between IDR pictures that nobody asked for
BT709, SRGB, LIMITED_RANGE = 1, 13, 1  # code points of ITU-T H.273, and FFmpeg's AVCOL_RANGE_MPEG
SEQUENCE_PARAMETERS = b"\x00\x00\x01\x67"  # start code and header of that NAL unit
# Constant quality, of which x264 gives more to what moves less: with `veryfast` the demo's moving pictures take a
# ninth of their JPEGs and differ from them by 40 dB. Sliced threads would cost more than they save at such sizes.
OPTIONS = {
    SOFTWARE: {
        "preset": "veryfast",
        "tune": "zerolatency",
        "crf": "20",
        "forced-idr": "1",
        "sc_threshold": "0",
    },
    NVENC: {
        "preset": "p4",
        "tune": "ull",
        "rc": "vbr",
        "cq": "23",
        "b": "0",
        "zerolatency": "1",
        "forced-idr": "1",
    },
}


@dataclass(frozen=True)
class AccessUnit:
    """A coded picture; one `is_key` (an IDR picture) is decoded without those before it."""

    data: bytes
    is_key: bool


def why_unavailable() -> str | None:
    """Returns why there is no H.264 here, one sentence; None where there is."""
    try:
        import av
    except ImportError:
        return NO_AV
    return None if SOFTWARE in av.codecs_available else NO_ENCODER


class H264Encoder:
    """Encodes pictures of one size; NVIDIA's encoder does it where it opens, else x264 in the caller's thread.

    Odd sizes are enlarged by a copy of the last column or row; who shows the pictures cuts it off.

    Raises:
        DeltalightError: PyAV is missing, or no encoder takes the size.
    """

    def __init__(self, width: int, height: int) -> None:
        reason = why_unavailable()
        if reason is not None:
            raise DeltalightError(reason)
        self._context = _opened(width + width % 2, height + height % 2)
        self._count = 0
        self.name = self._context.name
        self.codec = ""  # as RFC 6381 names it, from the first picture on

    def encode(self, picture: UInt8[np.ndarray, "h w 3"], *, as_key: bool = False) -> AccessUnit:
        """Encodes an sRGB picture.

        Raises:
            DeltalightError: the encoder failed.
        """
        import av
        from av.video.frame import PictureType
        from av.video.reformatter import ColorRange, Colorspace

        frame = av.VideoFrame.from_ndarray(even_sized(picture), format="rgb24").reformat(
            format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
        )
        frame.pts, frame.time_base = self._count * TICKS_PER_S // USUAL_RATE, Fraction(1, TICKS_PER_S)
        frame.pict_type = PictureType.I if as_key or self._count == 0 else PictureType.NONE
        self._count += 1
        try:
            packets = self._context.encode(frame)
        except av.FFmpegError as fault:
            raise DeltalightError(f"The encoder {self.name} failed: {fault.strerror}.") from fault
        if len(packets) != 1:
            raise DeltalightError(f"The encoder {self.name} keeps pictures back.")
        unit = AccessUnit(bytes(packets[0]), packets[0].is_keyframe)
        if unit.is_key:
            self.codec = codec_name(unit.data)
        return unit


class H264Decoder:
    """Decodes access units; the first one must be a key.

    Raises:
        DeltalightError: PyAV is missing.
    """

    def __init__(self) -> None:
        try:
            import av
        except ImportError as fault:
            raise DeltalightError(NO_AV) from fault
        self._context = av.CodecContext.create("h264", "r")
        self._context.thread_count = 1  # more would keep pictures back

    def decode(self, data: bytes, width: int, height: int) -> UInt8[np.ndarray, "height width 3"]:
        """Returns the picture of an access unit, sRGB.

        Raises:
            DeltalightError: it is damaged, or builds on one that did not come.
        """
        import av

        try:
            frames = self._context.decode(av.Packet(data))
        except av.FFmpegError as fault:
            raise DeltalightError(f"An H.264 picture cannot be decoded: {fault.strerror}.") from fault
        if len(frames) != 1 or frames[0].height < height or frames[0].width < width:
            raise DeltalightError("An H.264 picture cannot be decoded: its size differs from its header.")
        return rgb_picture(frames[0])[:height, :width]


def rgb_picture(frame: "VideoFrame") -> UInt8[np.ndarray, "h w 3"]:
    """Returns a decoded picture of this encoder's streams, sRGB."""
    from av.video.reformatter import ColorRange, Colorspace

    picture = frame.reformat(
        format="rgb24",
        src_colorspace=Colorspace.ITU709,
        src_color_range=ColorRange.MPEG,
        dst_color_range=ColorRange.JPEG,
    )
    return picture.to_ndarray().astype(np.uint8, copy=False)


def even_sized(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Repeats the last row and column where a size is odd: colour has half the resolution."""
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def codec_name(data: bytes) -> str:
    """Returns the name of a stream by its first parameter set, such as `avc1.64001e` (RFC 6381, 3.3).

    Raises:
        DeltalightError: it has none.
    """
    start = data.find(SEQUENCE_PARAMETERS)
    profile = data[start + len(SEQUENCE_PARAMETERS) :][:3]
    if start < 0 or len(profile) < 3:
        raise DeltalightError("The encoder's pictures do not say their profile.")
    return f"avc1.{profile.hex()}"


def _opened(width: int, height: int) -> "VideoCodecContext":
    import av

    fault: Exception | None = None
    for name in (NVENC, SOFTWARE):
        try:
            context = cast("VideoCodecContext", av.CodecContext.create(name, "w"))
            context.width, context.height, context.pix_fmt = width, height, "yuv420p"
            context.time_base, context.framerate = Fraction(1, TICKS_PER_S), Fraction(USUAL_RATE)
            context.gop_size, context.max_b_frames, context.thread_count = NO_PERIOD, 0, 1
            context.color_primaries = context.colorspace = BT709
            context.color_trc, context.color_range = SRGB, LIMITED_RANGE
            context.options = OPTIONS[name]
            context.open()
        except (ValueError, OSError, av.FFmpegError) as refusal:  # no such device, or not of this size
            fault = refusal
        else:
            return context
    raise DeltalightError(f"No H.264 encoder takes pictures of {width}x{height} ({fault}).")
