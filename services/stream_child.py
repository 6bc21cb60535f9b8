"""The process that sends coded pictures to a media server by PyAV: `python -m deltalight.services.stream_child`.

FFmpeg blocks while it connects and while a server takes nothing; a process of its own can be ended meanwhile. It
reads one line of JSON (a `StreamSpec`), then packets: `PACKET`, and the access unit. For each it writes one line:
empty once it was sent, else why not, and then ends. The address comes this way, so that no list of processes shows a
password.
"""

import json
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from fractions import Fraction
from typing import BinaryIO

from deltalight.services.h264 import TICKS_PER_S
from deltalight.services.parent_death_signal import end_with_supervisor
from deltalight.services.srt import SrtAddress, SrtCaller

PACKET = struct.Struct("<QBI")  # time in ticks, whether it is a key, bytes
RATE = 30  # that is announced; each picture has its own time


@dataclass(frozen=True)
class StreamSpec:
    """Where to, as what container of FFmpeg, and the size of the pictures."""

    url: str
    container: str
    options: dict[str, str]
    width: int
    height: int

    def line(self) -> bytes:
        """Returns it as a line."""
        return json.dumps(asdict(self)).encode() + b"\n"


def send(spec: StreamSpec, packets: Iterator[tuple[int, bool, bytes]], answers: BinaryIO) -> None:
    """Sends packets and answers each; the connection begins with the first."""
    import av

    ticks = Fraction(1, TICKS_PER_S)
    try:
        with (
            _opened(spec.url) as target,
            av.open(target, "w", format=spec.container, options=spec.options) as container,
        ):
            stream = container.add_mux_stream(
                "h264", rate=RATE, width=spec.width, height=spec.height, time_base=ticks
            )
            for time_ticks, is_key, data in packets:
                packet = av.Packet(data)
                packet.stream, packet.time_base = stream, ticks
                packet.pts = packet.dts = time_ticks
                packet.is_keyframe = is_key
                container.mux(packet)
                _answer(answers, "")
    except (OSError, ValueError, av.FFmpegError) as fault:
        _answer(answers, getattr(fault, "strerror", None) or str(fault))


@contextmanager
def _opened(url: str) -> Iterator[str | SrtCaller]:
    """Yields what PyAV writes to: an address of FFmpeg's, or a connection by SRT, which it has not."""
    if not url.startswith("srt:"):
        yield url
        return
    with SrtCaller(SrtAddress.parse(url)) as caller:
        yield caller


def _answer(answers: BinaryIO, text: str) -> None:
    answers.write(" ".join(text.split()).encode() + b"\n")
    answers.flush()


def _packets(source: BinaryIO) -> Iterator[tuple[int, bool, bytes]]:
    while len(head := source.read(PACKET.size)) == PACKET.size:
        time_ticks, is_key, length = PACKET.unpack(head)
        yield time_ticks, bool(is_key), source.read(length)


if __name__ == "__main__":
    end_with_supervisor()
    send(StreamSpec(**json.loads(sys.stdin.buffer.readline())), _packets(sys.stdin.buffer), sys.stdout.buffer)
