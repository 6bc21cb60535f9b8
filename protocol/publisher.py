"""Sender of streams: a PUB socket that never waits for subscribers."""

import threading
from collections.abc import Sequence

import zmq

from deltalight.protocol.curve import guard
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys
from deltalight.protocol.messages import MAX_PART_BYTES
from deltalight.protocol.sockets import HIGH_WATER_MARK, attach, open_context, open_socket

STREAMS_OF_A_NODE = 9


class Publisher:
    """Publishes multiparts to all subscribers; a subscriber that is too slow misses messages.

    `streams` is the number of messages sent in a row for one frame. The queue to each subscriber holds two frames of
    that many messages: one shorter than such a row would always lose its last messages (the pose). `keys` are
    required if the endpoint leaves the host.
    """

    def __init__(
        self,
        endpoint: str,
        *,
        bind: bool = True,
        streams: int = STREAMS_OF_A_NODE,
        keys: Keys | None = None,
    ) -> None:
        self._context = open_context()
        self._lock = threading.Lock()
        self._socket = open_socket(self._context, zmq.PUB, high_water_mark=HIGH_WATER_MARK * streams)
        self._guard = guard(self._context, self._socket, keys, bind=bind)
        try:
            self.endpoint = attach(self._socket, endpoint, bind=bind, keys=keys)
        except DeltalightError:
            self.close()
            raise

    @property
    def refused(self) -> int:
        """Number of connections refused because of wrong keys."""
        return 0 if self._guard is None else self._guard.refused

    def send(self, multipart: Sequence[bytes | memoryview]) -> None:
        """Sends one multipart [topic, header, part...]; its bytes are copied before this returns.

        Raises:
            DeltalightError: a piece is too large for the receivers, or the publisher is closed.
        """
        largest = max(len(piece) for piece in multipart)
        if largest > MAX_PART_BYTES:
            raise DeltalightError(
                f"a part has {largest} bytes and {MAX_PART_BYTES} are allowed; send smaller pictures."
            )
        with self._lock:
            if self._socket.closed:
                raise DeltalightError("the publisher is closed; open a new one to send.")
            self._socket.send_multipart(multipart)

    def close(self, linger_ms: int = 0) -> None:
        """Closes the socket; discards what is still queued after `linger_ms`."""
        if self._guard is not None:
            self._guard.close()
        with self._lock:
            self._context.destroy(linger_ms)
