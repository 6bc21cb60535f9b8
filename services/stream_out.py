"""The relit picture to a media server (RTSP, RTMP, SRT; extra `video`), which serves crowds from there."""

import os
import select
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self
from urllib.parse import urlsplit

import numpy as np
from jaxtyping import UInt8

from deltalight.protocol.errors import DeltalightError
from deltalight.services.h264 import TICKS_PER_S, AccessUnit, H264Encoder
from deltalight.services.parent_death_signal import SUPERVISOR_VARIABLE
from deltalight.services.srt import SrtAddress
from deltalight.services.stream_child import PACKET, StreamSpec

KEY_INTERVAL_S = 2.0  # who joins at the server waits so long; media servers begin segments with keys
REPEAT_AFTER_S = 1.0  # the last picture, while there is no newer one: servers end silent streams
ANSWER_TIMEOUT_S = 10.0  # for a connection, and for a picture to be taken
CLOSE_TIMEOUT_S = 2.0  # for the goodbye
FIRST_WAIT_S, LONGEST_WAIT_S = 1.0, 30.0  # between tries to connect
RTSP = ("rtsp", {"rtsp_transport": "tcp"})
CONTAINERS: dict[str, tuple[str, dict[str, str]]] = {
    "rtsp": RTSP,
    "rtsps": RTSP,
    "rtmp": ("flv", {}),
    "rtmps": ("flv", {}),
    "srt": ("mpegts", {"flush_packets": "1"}),
}

Picture = UInt8[np.ndarray, "h w 3"]


class StreamEndedError(DeltalightError):
    """The server does not take pictures (any more); its text says why, without who and where."""


@dataclass(frozen=True)
class Target:
    """Where pictures go; `shown` leaves out of `url` what may be secret: user, password, path and query."""

    url: str
    shown: str
    container: str
    options: dict[str, str]

    @classmethod
    def parse(cls, url: str) -> Self:
        """Reads an address.

        Raises:
            DeltalightError: there is no way to it.
        """
        try:
            parts = urlsplit(url)
            host, port = parts.hostname, parts.port
        except ValueError:
            host, port = None, None
        else:
            if parts.scheme not in CONTAINERS:
                host = None
        if host is None or not url.isprintable() or " " in url:
            schemes = ", ".join(f"{each}://" for each in CONTAINERS)
            raise DeltalightError(
                f"--to takes an address such as rtsp://HOST:8554/NAME; it begins with one of {schemes}."
            )
        if parts.scheme == "srt":
            SrtAddress.parse(url)
        place = f"[{host}]" if ":" in host else host
        shown = f"{parts.scheme}://{place}" + (f":{port}" if port else "")
        return cls(url, shown, *CONTAINERS[parts.scheme])


@dataclass
class StreamStatus:
    """How it goes: pictures and bytes sent since the start, and whether a server takes them."""

    pictures: int = 0
    bytes: int = 0
    is_connected: bool = False


class StreamOut:
    """Sends pictures to a target, again and again; use it as a context manager.

    `tell` gets a sentence for each change of state.

    Raises:
        DeltalightError: H.264 is not there.
    """

    def __init__(self, target: Target, tell: Callable[[str], None]) -> None:
        self.status = StreamStatus()
        self._target, self._tell = target, tell
        self._sender: _Sender | None = None
        self._next_try_s, self._wait_s = 0.0, FIRST_WAIT_S
        self._told = ""

    def __enter__(self) -> Self:
        """Returns it; the connection begins with the first picture."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Says goodbye to the server."""
        if self._sender is not None:
            self._sender.close()

    def show(self, picture: Picture) -> None:
        """Sends an sRGB picture, unless the server is away; one of another size begins a new connection.

        Raises:
            DeltalightError: no encoder takes it.
        """
        if self._sender is not None and self._sender.size != picture.shape[:2]:
            self._sender.close()
            self._sender = None
        if self._sender is None:
            if time.monotonic() < self._next_try_s:
                return
            self._sender = _Sender(self._target, picture.shape[0], picture.shape[1])
        try:
            self.status.bytes += self._sender.send(picture)
        except StreamEndedError as fault:
            self._note_end(fault)
            return
        self.status.pictures += 1
        self._note_connection(picture)

    def _note_connection(self, picture: Picture) -> None:
        if not self.status.is_connected:
            height, width = picture.shape[:2]
            self._say(
                f"{self._target.shown} is receiving the relit picture, {width}x{height}; press Ctrl-C to stop."
            )
        self.status.is_connected, self._wait_s = True, FIRST_WAIT_S

    def _note_end(self, fault: StreamEndedError) -> None:
        assert self._sender is not None
        self._sender.close()
        self._sender = None
        self._next_try_s = time.monotonic() + self._wait_s
        self._wait_s = min(2 * self._wait_s, LONGEST_WAIT_S)
        verb = "takes no more pictures" if self.status.is_connected else "takes no pictures"
        self.status.is_connected = False
        self._say(f"{self._target.shown} {verb} ({fault}); trying again until it does.")

    def _say(self, sentence: str) -> None:
        if sentence != self._told:
            self._tell(sentence)
        self._told = sentence


class _Sender:
    """One connection, by a `stream_child`, with an encoder of its own: it begins with a key."""

    def __init__(self, target: Target, height: int, width: int) -> None:
        self.size = height, width
        self._encoder = H264Encoder(width, height)
        self._began_s, self._key_due_s = time.monotonic(), 0.0
        self._sent_ticks = -1
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "deltalight.services.stream_child"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # FFmpeg's words, in which addresses stand with passwords
            bufsize=0,
            start_new_session=True,  # Ctrl-C does not reach it, so that it can say goodbye
            env={**os.environ, SUPERVISOR_VARIABLE: str(os.getpid())},
        )
        even = height + height % 2, width + width % 2
        self._begin = StreamSpec(target.url, target.container, target.options, even[1], even[0]).line()

    def send(self, picture: Picture) -> int:
        """Sends a picture and returns its bytes, once they were taken.

        Raises:
            StreamEndedError: they were not.
            DeltalightError: the encoder failed.
        """
        now_s = time.monotonic()
        unit = self._encoder.encode(picture, as_key=now_s >= self._key_due_s)
        if unit.is_key:
            self._key_due_s = now_s + KEY_INTERVAL_S
        self._sent_ticks = max(self._sent_ticks + 1, round((now_s - self._began_s) * TICKS_PER_S))
        begin, self._begin = self._begin, b""
        self._write(begin + _packed(self._sent_ticks, unit))
        if reason := self._answer():
            raise StreamEndedError(reason)
        return len(unit.data)

    def close(self) -> None:
        """Ends the process; a second Ctrl-C meanwhile leaves none behind."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.close()
            self._process.wait(CLOSE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            pass
        finally:
            self._process.kill()
            self._process.wait()
            self._process.stdout.close()

    def _write(self, data: bytes) -> None:
        assert self._process.stdin is not None
        try:
            view = memoryview(data)
            while view:
                view = view[self._process.stdin.write(view) :]
        except OSError as fault:
            raise StreamEndedError(self._answer() or "its process ended") from fault

    def _answer(self) -> str:
        """Waits for an answer; it is empty for a packet that was sent."""
        assert self._process.stdout is not None
        line, deadline_s = b"", time.monotonic() + ANSWER_TIMEOUT_S
        while not line.endswith(b"\n"):
            left_s = max(0.0, deadline_s - time.monotonic())
            if not select.select([self._process.stdout], [], [], left_s)[0]:
                return f"no answer for {ANSWER_TIMEOUT_S:g} s"
            chunk = self._process.stdout.read(4096)
            if not chunk:
                return "its process ended"
            line += chunk
        return line.decode(errors="replace").strip()


def _packed(time_ticks: int, unit: AccessUnit) -> bytes:
    return PACKET.pack(time_ticks, unit.is_key, len(unit.data)) + unit.data
