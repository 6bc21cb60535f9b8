"""Events of the service, published to every client of the events WebSocket."""

import asyncio
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

from pydantic_core import to_json

QUEUE_EVENTS = 256  # how far a client may lag: a minute of reports from four processes

EventType = Literal[
    "hello",
    "scene",
    "asset",
    "picture",
    "process",
    "recording",
    "replay",
    "snapshot",
    "notice",
    "rooms",
    "cameras",
    "lost",
]
IN_ALL_ROOMS: frozenset[EventType] = frozenset({"asset", "recording", "snapshot", "rooms"})
# To the listeners of other web processes, which hear the rest themselves.
PASSED_ON: frozenset[EventType] = frozenset({"scene", "asset", "recording", "replay", "snapshot", "notice"})


@dataclass(eq=False)
class EventQueue:
    """Events that are still to be sent to one client; a full queue drops the oldest and counts it."""

    loop: asyncio.AbstractEventLoop
    lost: int = 0
    _waiting: deque[str] = field(default_factory=deque)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _arrived: asyncio.Event = field(default_factory=asyncio.Event)

    def put(self, text: str) -> None:
        """Adds an event (any thread)."""
        with self._lock:
            if len(self._waiting) == QUEUE_EVENTS:
                self._waiting.popleft()
                self.lost += 1
            self._waiting.append(text)
        if not self.loop.is_closed():
            self.loop.call_soon_threadsafe(self._arrived.set)

    async def next(self) -> str:
        """Waits for the oldest event; if any were dropped before it, their number comes first."""
        while True:
            with self._lock:
                if self.lost:
                    count, self.lost = self.lost, 0
                    return packed("lost", {"count": count})
                if self._waiting:
                    return self._waiting.popleft()
                self._arrived.clear()
            await self._arrived.wait()


class EventHub:
    """Publishes events to all listeners; each is encoded once, and slow listeners delay nobody.

    What all rooms share (assets, recordings) the `others`' listeners hear too. `pass_on` gets what listeners of other
    web processes should hear.
    """

    def __init__(self) -> None:
        self.others: Sequence[EventHub] = ()
        self.pass_on: Callable[[str], None] = lambda _text: None
        self._queues: set[EventQueue] = set()
        self._lock = threading.Lock()

    def publish(self, type: EventType, body: Mapping[str, object]) -> None:
        """Publishes an event (any thread); `body` is anything that pydantic serialises, models and times included."""
        if type in PASSED_ON:
            self.pass_on(packed(type, body))
        self.deliver(type, body)

    def deliver(self, type: EventType, body: Mapping[str, object]) -> None:
        """Publishes an event to the listeners of this process alone (any thread)."""
        hubs = (self, *self.others) if type in IN_ALL_ROOMS else (self,)
        queues = [queue for hub in hubs for queue in hub.queues()]
        if queues:
            text = packed(type, body)
            for queue in queues:
                queue.put(text)

    def queues(self) -> tuple[EventQueue, ...]:
        """Returns the queues of its own listeners."""
        with self._lock:
            return tuple(self._queues)

    @property
    def listeners(self) -> int:
        """The number of listeners."""
        return len(self._queues)

    @contextmanager
    def listening(self) -> Iterator[EventQueue]:
        """Subscribes to all events for the duration of the block (in the event loop that takes them)."""
        queue = EventQueue(asyncio.get_running_loop())
        with self._lock:
            self._queues.add(queue)
        try:
            yield queue
        finally:
            with self._lock:
                self._queues.remove(queue)


def packed(type: EventType, body: Mapping[str, object]) -> str:
    """Returns an event as it is sent: a JSON object with its type."""
    return to_json({"type": type, **body}, inf_nan_mode="null").decode()
