"""Receiving streams: a thread that owns the SUB socket and hands over each message at once."""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence

import zmq

from deltalight.protocol.curve import Guard, guard, sender_key, uses_keys
from deltalight.protocol.envelope import MAX_TOPIC_BYTES
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys
from deltalight.protocol.rights import Rights
from deltalight.protocol.sockets import HIGH_WATER_MARK, attach, check_endpoint, open_context, open_socket


class ReceivedMultipart(list[memoryview]):
    """Pieces of one message, [topic, header, part...], and its time of arrival."""

    received_ns: int

    def __init__(self, pieces: Sequence[memoryview], received_ns: int) -> None:
        super().__init__(pieces)
        self.received_ns = received_ns


class Subscriber(ABC):
    """Subscribes to endpoints; a subclass stores the messages and waits on `_changed` for them.

    With keys, what the host of an endpoint may not publish (`rights`) is left out. The subclass must set its own
    fields before it calls this constructor, which starts the thread.

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
        self._keys, self._rights = keys, None if keys is None else Rights(keys)
        self._context = open_context()
        self._guards: list[Guard] = []
        self._keys_of: dict[zmq.Socket[bytes], bytes | None] = {}  # of the host at a socket's other end
        self._subscriptions, self._high_water_mark = tuple(subscriptions), high_water_mark
        try:
            shared = self._opened(bind=bind)
            self.endpoints = tuple(self._attach(endpoint, shared, bind=bind) for endpoint in endpoints)
        except DeltalightError:
            self._close_guards()
            self._context.destroy(0)
            raise
        self._thread = threading.Thread(target=self._run, name="subscriber", daemon=True)
        self._thread.start()

    @abstractmethod
    def _store(self, message: ReceivedMultipart) -> None:
        """Stores a message or counts it; called by the thread."""

    @property
    def not_allowed(self) -> int:
        """Number of messages that trusted hosts sent and may not."""
        return 0 if self._rights is None else self._rights.refused

    def close(self) -> None:
        """Stops the thread and wakes all waiters; stored messages can still be taken."""
        self._close_guards()
        self._context.term()  # interrupts the thread, which closes its own sockets
        self._thread.join()

    def _attach(self, endpoint: str, shared: "zmq.Socket[bytes]", *, bind: bool) -> str:
        """Attaches an endpoint; a host with a key has a socket of its own, which tells whose messages come."""
        parts, keys = check_endpoint(endpoint, self._keys), self._keys
        if bind or keys is None or not uses_keys(parts, keys):
            return attach(shared, endpoint, bind=bind, keys=keys)
        socket = self._opened(bind=False)
        self._keys_of[socket] = keys.peer(parts)
        return attach(socket, endpoint, bind=False, keys=keys)

    def _opened(self, *, bind: bool) -> "zmq.Socket[bytes]":
        socket = open_socket(self._context, zmq.SUB, high_water_mark=self._high_water_mark)
        self._keys_of[socket] = None
        watching = guard(self._context, socket, self._keys, bind=bind)
        if watching is not None:
            self._guards.append(watching)
        for subscription in self._subscriptions:
            socket.subscribe(subscription)
        return socket

    def _close_guards(self) -> None:
        for each in self._guards:
            each.close()

    def _run(self) -> None:
        poller = zmq.Poller()
        for socket in self._keys_of:
            poller.register(socket, zmq.POLLIN)
        try:
            while True:
                for socket, _ in poller.poll():
                    self._take(socket)
        except zmq.ContextTerminated:
            pass
        finally:
            for socket in self._keys_of:
                socket.close(0)
            with self._changed:
                self._closed = True
                self._changed.notify_all()

    def _take(self, socket: "zmq.Socket[bytes]") -> None:
        frames = socket.recv_multipart(copy=False)
        key = self._keys_of[socket] or sender_key(frames[0])
        if key is not None and self._rights is not None:
            topic = bytes(frames[0].buffer[:MAX_TOPIC_BYTES]).decode("ascii", errors="replace")
            if not self._rights.lets(key, topic):
                return
        self._store(ReceivedMultipart([frame.buffer for frame in frames], time.time_ns()))
