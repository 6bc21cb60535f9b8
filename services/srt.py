"""SRT (Secure Reliable Transport, draft-sharabayko-srt-01) by the system's libsrt.

FFmpeg in PyAV's wheels has none.
"""

import ctypes
import io
import socket
import struct
from collections.abc import Callable
from ctypes.util import find_library
from dataclasses import dataclass
from typing import Any, Self
from urllib.parse import parse_qsl, urlsplit

from deltalight.protocol.errors import DeltalightError

LIBRARIES = ("srt", "srt-gnutls", "srt-openssl")  # as Debian and others name it
NO_LIBRARY = "srt:// needs the system's libsrt (Debian: apt-get install libsrt1.5-openssl)."
PAYLOAD_BYTES = 1316  # seven packets of MPEG-TS, which media servers expect
TIMEOUT_MS = 5_000  # for a connection, and for a payload to be taken
# SRT_SOCKOPT of srt.h
SEND_TIMEOUT, PASSPHRASE, KEY_BYTES, CONNECT_TIMEOUT, PEER_LATENCY, STREAM_ID = 13, 26, 27, 36, 44, 46
INVALID_SOCKET = -1


@dataclass(frozen=True)
class SrtAddress:
    """Where to call: `srt://HOST:PORT?streamid=...&passphrase=...&pbkeylen=16&latency=120` (ms)."""

    host: str
    port: int
    options: tuple[tuple[int, str | int], ...]

    @classmethod
    def parse(cls, url: str) -> Self:
        """Reads an address.

        Raises:
            DeltalightError: it has no host or port, or a part that is unknown or out of its range.
        """
        parts = urlsplit(url)
        if parts.hostname is None or not parts.port:
            raise DeltalightError(
                "An SRT address has a host and a port, such as srt://HOST:8890?streamid=NAME."
            )
        query = parts.query + (f"#{parts.fragment}" if parts.fragment else "")  # `#!::r=NAME`, often as it is
        options = []
        for key, value in parse_qsl(query, keep_blank_values=True):
            if key not in QUERY:
                raise DeltalightError(
                    f"An SRT address takes {', '.join(QUERY)}, each once, not '{key:.40}'; it is always the caller."
                )
            number, read = QUERY[key]
            options.append((number, read(value)))
        if len({number for number, _ in options}) < len(options):
            raise DeltalightError(f"An SRT address takes {', '.join(QUERY)}, each once.")
        return cls(parts.hostname, parts.port, tuple(options))


def _stream_id(text: str) -> str:
    if not 1 <= len(text.encode()) <= 512:
        raise DeltalightError("streamid of an SRT address has 1 to 512 bytes.")
    return text


def _passphrase(text: str) -> str:
    if not 10 <= len(text.encode()) <= 79:
        raise DeltalightError("passphrase of an SRT address has 10 to 79 bytes.")
    return text


def _key_bytes(text: str) -> int:
    if text not in ("16", "24", "32"):
        raise DeltalightError("pbkeylen of an SRT address is 16, 24 or 32 (bytes).")
    return int(text)


def _latency_ms(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 5 and int(text) <= 30_000):
        raise DeltalightError("latency of an SRT address is 0 to 30000 (ms).")
    return int(text)


QUERY: dict[str, tuple[int, Callable[[str], str | int]]] = {
    "streamid": (STREAM_ID, _stream_id),
    "passphrase": (PASSPHRASE, _passphrase),
    "pbkeylen": (KEY_BYTES, _key_bytes),
    "latency": (PEER_LATENCY, _latency_ms),
}


def why_unavailable() -> str | None:
    """Returns what is missing for SRT, None if nothing is."""
    return None if _library_name() else NO_LIBRARY


class SrtCaller(io.RawIOBase):
    """A connection to a listener that takes MPEG-TS by `write`, in SRT's live mode; use it as a context manager.

    Raises:
        OSError: nobody answers there, the listener refuses, or (by `write`) it takes nothing any more.
    """

    def __init__(self, address: SrtAddress) -> None:
        super().__init__()
        self._srt: Any = ctypes.CDLL(_library_name())
        self._srt.srt_getlasterror_str.restype = ctypes.c_char_p
        self._srt.srt_rejectreason_str.restype = ctypes.c_char_p
        self._srt.srt_setloglevel(0)
        self._check(self._srt.srt_startup())
        self._socket = self._check(self._srt.srt_create_socket())
        for number, value in (*address.options, (SEND_TIMEOUT, TIMEOUT_MS), (CONNECT_TIMEOUT, TIMEOUT_MS)):
            self._set(number, value)
        self._connect(address)

    def writable(self) -> bool:
        """Returns true."""
        return True

    def write(self, data: Any) -> int:  # noqa: ANN401 (whatever has a buffer)
        """Sends bytes, in payloads of whole packets of MPEG-TS; returns how many."""
        view = memoryview(data).cast("B")
        for begin in range(0, len(view), PAYLOAD_BYTES):
            payload = bytes(view[begin : begin + PAYLOAD_BYTES])
            self._check(self._srt.srt_send(self._socket, payload, len(payload)))
        return len(view)

    def close(self) -> None:
        """Closes the connection."""
        if not self.closed:
            self._srt.srt_close(self._socket)
        super().close()

    def _set(self, number: int, value: str | int) -> None:
        packed = value.encode() if isinstance(value, str) else struct.pack("i", value)
        self._check(self._srt.srt_setsockflag(self._socket, number, packed, len(packed)))

    def _connect(self, address: SrtAddress) -> None:
        place = _packed_place(address.host, address.port)
        if self._srt.srt_connect(self._socket, place, len(place)) == INVALID_SOCKET:
            reason = self._srt.srt_getrejectreason(self._socket)
            refused = self._srt.srt_rejectreason_str(reason).decode() if reason else ""
            raise OSError(f"{self._last_error()}; {refused}" if refused else self._last_error())

    def _check(self, result: int) -> int:
        if result == INVALID_SOCKET:
            raise OSError(self._last_error())
        return result

    def _last_error(self) -> str:
        return str(self._srt.srt_getlasterror_str().decode(errors="replace")).rstrip(".")


def _library_name() -> str | None:
    return next(filter(None, map(find_library, LIBRARIES)), None)


def _packed_place(host: str, port: int) -> bytes:
    """Returns a `sockaddr` of Linux."""
    family, _, _, _, (name, *_, scope) = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    packed = socket.inet_pton(family, str(name).partition("%")[0])
    head = struct.pack("=H", family) + struct.pack(">H", port)
    if family == socket.AF_INET:
        return head + packed + bytes(8)
    return head + bytes(4) + packed + struct.pack("=I", scope)
