"""H.264 video files (extra `video`): pictures at the times at which they were captured, in constant quality."""

import statistics
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from jaxtyping import UInt8

from deltalight.protocol.errors import DeltalightError, install_command
from deltalight.services.files import appearing, make_output_folder
from deltalight.services.h264 import even_sized

if TYPE_CHECKING:
    from av.container import OutputContainer
    from av.video.stream import VideoStream

VIDEO_SUFFIX = ".mp4"
CODEC = "libx264"
# Constant rate factor: 18 is commonly taken as visually lossless (FFmpeg's H.264 guide).
QUALITY = {"crf": "18"}
TICKS_PER_S = 90_000  # of MPEG's clock, which every player knows
USUAL_RATE = Fraction(30)  # of a single picture
BT709, LIMITED_RANGE = 1, 1  # ITU-T H.273: primaries, transfer and matrix of BT.709; 16 to 235
NO_AV = f"mp4 files need the package av (PyAV): {install_command('av')}."
INSTEAD = "Or name a folder, for pictures."


class VideoWriter:
    """Writes pictures to an open container; `video_file` opens one. The first picture sets the size."""

    def __init__(self, container: "OutputContainer", rate: Fraction) -> None:
        self._container, self._rate = container, rate
        self._stream: VideoStream | None = None
        self._first_ns = self._last_ns = -1
        self.frames = 0

    def add(self, picture: UInt8[np.ndarray, "h w 3"], timestamp_ns: int) -> None:
        """Appends an sRGB picture, later than the one before.

        Raises:
            DeltalightError: it is not later, or has another size than the first.
        """
        import av
        from av.video.reformatter import ColorRange, Colorspace

        if timestamp_ns <= self._last_ns:
            raise DeltalightError("A picture is not later than the one before; give them in order of time.")
        even = even_sized(picture)
        if self._stream is None:
            self._stream = self._begin(even)
            self._first_ns = timestamp_ns
        if even.shape[:2] != (self._stream.height, self._stream.width):
            raise DeltalightError(
                "Pictures of several sizes do not go into one video; export them as a folder."
            )
        frame = av.VideoFrame.from_ndarray(even, format="rgb24").reformat(
            format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
        )
        frame.pts = round((timestamp_ns - self._first_ns) * TICKS_PER_S / 1e9)
        frame.time_base = Fraction(1, TICKS_PER_S)
        self._container.mux(self._stream.encode(frame))
        self._last_ns = timestamp_ns
        self.frames += 1

    def finish(self) -> None:
        """Writes what the encoder still holds.

        Raises:
            DeltalightError: there was no picture.
        """
        if self._stream is None:
            raise DeltalightError("There is no picture for a video; choose a recording that has some.")
        self._container.mux(self._stream.encode())

    def _begin(self, picture: UInt8[np.ndarray, "h w 3"]) -> "VideoStream":
        stream = cast("VideoStream", self._container.add_stream(CODEC, rate=self._rate, options=QUALITY))
        stream.height, stream.width = picture.shape[:2]
        stream.pix_fmt = "yuv420p"
        context = stream.codec_context
        context.time_base = Fraction(1, TICKS_PER_S)
        context.color_primaries = context.color_trc = context.colorspace = BT709
        context.color_range = LIMITED_RANGE
        return stream


@contextmanager
def video_file(path: Path, timestamps_ns: Sequence[int]) -> Iterator[VideoWriter]:
    """Opens a video that appears at `path` when the block ends, and not at all when that raises.

    `timestamps_ns` are the times of its pictures: the rate in its header is that of their median step.

    Raises:
        DeltalightError: PyAV or its encoder is missing, the name is taken, or the disk refuses.
    """
    require_video_support()
    import av

    make_output_folder(path.parent)
    with appearing(path) as temporary, av.open(str(temporary), "w") as container:
        writer = VideoWriter(container, _rate(timestamps_ns))
        yield writer
        writer.finish()


def require_video_support(instead: str = INSTEAD) -> None:
    """Refuses early, with what to do instead.

    Raises:
        DeltalightError: PyAV is not installed, or its FFmpeg has no H.264 encoder of constant quality.
    """
    try:
        import av
    except ImportError as fault:
        raise DeltalightError(f"{NO_AV} {instead}") from fault
    if CODEC not in av.codecs_available:
        raise DeltalightError(
            f"The FFmpeg of this PyAV has no encoder {CODEC}; install the wheel of the package av, or name a folder."
        )


def _rate(timestamps_ns: Sequence[int]) -> Fraction:
    steps_ns = [after - before for before, after in pairwise(timestamps_ns)]
    if not steps_ns:
        return USUAL_RATE
    return Fraction(10**9, round(statistics.median(steps_ns))).limit_denominator(1001)
