"""Workers of `asset_worker` that are forked from one process, which has imported what they need."""

import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

PIECE_BYTES = 1 << 16
SOON_S = 0.001  # a timeout of 0 would not wait at all


class WorkerForks:
    """Runs workers; the process that forks them starts with the first one, and ends after a while without work.

    `module` is that process: it gets a socket as standard input (`asset_worker`). Only Linux forks safely.
    """

    def __init__(self, module: str, environment: Mapping[str, str]) -> None:
        self._command = [sys.executable, "-P", "-m", module]
        self._environment = environment
        self._lock = threading.Lock()
        self._requests: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def run(self, words: Sequence[str], timeout_s: float) -> str:
        """Forks a worker with these arguments and returns what it prints; what is left after a crash may be nothing.

        Raises:
            TimeoutError: it still runs. The worker ends itself.
            OSError: no process can be had.
        """
        deadline_s = time.monotonic() + timeout_s
        ours, theirs = socket.socketpair()
        with ours:
            with theirs, self._lock:
                self._send(json.dumps([str(Path.cwd()), *words]).encode(), theirs)
            return _all_of(ours, deadline_s).decode(errors="replace")

    def _send(self, request: bytes, answer: socket.socket) -> None:
        if self._requests is not None:
            with suppress(OSError):  # it has ended, for want of work
                socket.send_fds(self._requests, [request], [answer.fileno()])
                return
        socket.send_fds(self._started(), [request], [answer.fileno()])

    def _started(self) -> socket.socket:
        self.close()
        ours, theirs = socket.socketpair(type=socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(
                self._command,
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env={**os.environ, **self._environment},
            )
        self._requests = ours
        # It ends by itself, at any time; somebody has to wait for it.
        threading.Thread(target=self._process.wait, name="forking process", daemon=True).start()
        return ours

    def close(self) -> None:
        """Ends the process that forks; the next worker starts another."""
        if self._requests is not None:
            self._requests.close()
        if self._process is not None:
            self._process.wait()
        self._requests = self._process = None


def _all_of(answer: socket.socket, deadline_s: float) -> bytes:
    read = bytearray()
    while True:
        answer.settimeout(max(deadline_s - time.monotonic(), SOON_S))
        piece = answer.recv(PIECE_BYTES)
        if not piece:
            return bytes(read)
        read += piece
