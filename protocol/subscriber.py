"""Receiving streams: a thread that owns the SUB socket and hands over each message at once."""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence

import zmq

from deltalight.protocol.curve import guard
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys
from deltalight.protocol.sockets import HIGH_WATER_MARK, attach, open_socket


class ReceivedMultipart(list[memoryview]):
    """Pieces of one message, [topic, header, part...], and its time of arrival."""

    received_ns: int

    def __init__(self, pieces: Sequence[memoryview], received_ns: int) -> None:
        super().__init__(pieces)
        self.received_ns = received_ns


class Subscriber(ABC):
    """Subscribes to endpoints; a subclass stores the messages and waits on `_changed` for them.

    The subclass must set its own fields before it calls this constructor, which starts the thread.

    Raises:
        DeltalightError: an endpoint leaves the host without keys, or is malformed.
    """

    def __init__(
        self,
        endpoints: Sequence[str],
        subscriptions: Sequence[str],
        *,
        bind: bool = False,
        keys: Keys | None = None,
        high_water_mark: int = HIGH_WATER_MARK,
    ) -> None:
        self._changed = threading.Condition()
        self._closed = False
        self._context = zmq.Context()
        self._socket = open_socket(self._context, zmq.SUB, high_water_mark=high_water_mark)
        self._guard = guard(self._context, self._socket, keys, bind=bind)
        for subscription in subscriptions:
            self._socket.subscribe(subscription)
        try:
            self.endpoints = tuple(attach(self._socket, each, bind=bind, keys=keys) for each in endpoints)
        except DeltalightError:
            self._close_guard()
            self._context.destroy(0)
            raise
        self._thread = threading.Thread(target=self._run, name="subscriber", daemon=True)
        self._thread.start()

    @abstractmethod
    def _store(self, message: ReceivedMultipart) -> None:
        """Store a message or count it; called by the thread."""

    def close(self) -> None:
        """Stop the thread and wake all waiters; stored messages can still be taken."""
        self._close_guard()
        self._context.term()  # interrupts the thread, which closes its own socket
        self._thread.join()

    def _close_guard(self) -> None:
        if self._guard is not None:
            self._guard.close()

    def _run(self) -> None:
        try:
            while True:
                frames = self._socket.recv_multipart(copy=False)
                self._store(ReceivedMultipart([frame.buffer for frame in frames], time.time_ns()))
        except zmq.ContextTerminated:
            pass
        finally:
            self._socket.close(0)
            with self._changed:
                self._closed = True
                self._changed.notify_all()
