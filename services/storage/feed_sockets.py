"""The feed of a data folder: each process has a datagram socket there, FOLDER/.feed/ID (unix(7))."""

import os
import socket
import threading
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from uuid import uuid4

import structlog

from deltalight.protocol.errors import DeltalightError
from deltalight.services.storage.feed import LONGEST_BYTES, Feed

FOLDER = ".feed"
LOOK_S = 0.2  # how soon the end is noticed

log = structlog.get_logger()


class SocketFeed(Feed):
    """Sends each text to every socket in the folder but its own; those of killed processes are removed then."""

    def __init__(self, data: Path) -> None:
        super().__init__()
        self._name = uuid4().hex[:16]
        self._path = data / FOLDER
        self._folder: int | None = None
        self._opened = ExitStack()
        self._lock = threading.Lock()

    def start(self, hear: Callable[[str], None], missed: Callable[[], None]) -> None:
        """Makes the socket and begins to hear."""
        self._socket = self._opened.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        self._sender = self._opened.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        self._socket.settimeout(LOOK_S)
        self._sender.setblocking(False)
        try:
            self._path.mkdir(mode=0o700, exist_ok=True)
            self._folder = os.open(self._path, os.O_RDONLY | os.O_DIRECTORY)
            self._opened.callback(os.close, self._folder)
            self._socket.bind(_address(self._folder, self._name))
        except OSError as fault:
            raise DeltalightError(
                f"{self._path} cannot be written ({fault.strerror}); name another folder with --data."
            ) from fault
        self._opened.callback(_remove, self._folder, self._name)
        super().start(hear, missed)

    def _send(self, content: bytes) -> None:
        with self._lock:
            if self._folder is not None:
                for path in self._path.iterdir():
                    if path.name != self._name:
                        self._send_to(self._folder, path.name, content)

    def _send_to(self, folder: int, name: str, content: bytes) -> None:
        try:
            self._sender.sendto(content, _address(folder, name))
        except BlockingIOError:
            log.warning("another web process of this data folder does not keep up; it misses an event")
        except ConnectionRefusedError:  # it was killed
            _remove(folder, name)
        except OSError as fault:
            log.debug("an event was not passed on", fault=str(fault))

    def close(self) -> None:
        """Stops, and removes the socket."""
        super().close()
        with self._lock:
            self._folder = None
            self._opened.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            with suppress(TimeoutError):
                self._pass_on(self._socket.recv(LONGEST_BYTES).decode(errors="replace"))


def _address(folder: int, name: str) -> str:
    """Returns an address that fits: that of a socket may have 107 bytes."""
    return f"/proc/self/fd/{folder}/{name}"


def _remove(folder: int, name: str) -> None:
    with suppress(FileNotFoundError):
        os.unlink(name, dir_fd=folder)
