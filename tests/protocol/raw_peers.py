"""Peers that speak ZeroMQ's protocol (ZMTP 3.0, mechanism NULL) by hand, to do what no library does."""

import socket
import struct
from collections.abc import Sequence

MORE, LONG, COMMAND = 1, 2, 4
LINGER_NONE = struct.pack("ii", 1, 0)  # hang up at once, with a reset


def frame(body: bytes, *, kind: int = 0) -> bytes:
    """A frame: flags, length, body (ZMTP 3.0, RFC 23)."""
    if len(body) < 256:
        return bytes([kind, len(body)]) + body
    return bytes([kind | LONG]) + struct.pack(">Q", len(body)) + body


def multipart(pieces: Sequence[bytes]) -> bytes:
    """The frames of a multipart."""
    *first, last = pieces
    return b"".join(frame(piece, kind=MORE) for piece in first) + frame(last)


PING = frame(b"\x04PING\x00\x00", kind=COMMAND)
"""A heartbeat (ZMTP 3.1, RFC 37), after which the connection does not expire."""


class RawPeer:
    """Connects to a loopback port as a socket of this kind, or is one already."""

    def __init__(self, port: int, kind: str, connected: socket.socket | None = None) -> None:
        self.socket = connected or socket.create_connection(("127.0.0.1", port), timeout=10)
        greeting = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
        ready = b"\x05READY" + _property(b"Socket-Type", kind.encode()) + _property(b"Identity", b"")
        self.socket.sendall(greeting + frame(ready, kind=COMMAND))

    @classmethod
    def accepted(cls, listener: socket.socket, kind: str) -> "RawPeer":
        """Waits for one that connects to us."""
        connected, _ = listener.accept()
        connected.settimeout(10)
        return cls(0, kind, connected)

    def wait_until_ready(self) -> "RawPeer":
        """Waits for the other end's READY: what comes before it has sent that is a fault of the protocol."""
        received = b""
        while b"READY" not in received:
            chunk = self.socket.recv(4096)
            assert chunk, "the other end has hung up"
            received += chunk
        return self

    def send_what_fits(self, data: bytes) -> None:
        """Sends until the other end takes no more for a moment."""
        self.socket.settimeout(0.05)
        try:
            self.socket.sendall(data)
        except OSError:
            return

    def hang_up(self) -> None:
        """Resets the connection."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, LINGER_NONE)
        self.socket.close()


def _property(name: bytes, value: bytes) -> bytes:
    return bytes([len(name)]) + name + struct.pack(">I", len(value)) + value
