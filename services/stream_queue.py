"""Receiver of every message: a bounded queue."""

from collections import Counter, deque
from collections.abc import Sequence

from deltalight.protocol.envelope import MAX_PARTS, MAX_TOPIC_BYTES
from deltalight.protocol.keys import Keys
from deltalight.protocol.subscriber import ReceivedMultipart, Subscriber

QUEUED_MESSAGES = 64  # per topic: two seconds at 30 a second, which covers a slow disk
QUEUED_BYTES = 512 * 1024 * 1024  # of all topics together, if pictures are large and raw


class StreamQueue(Subscriber):
    """Messages in the order of their arrival; those that arrive while the queue is full are dropped and counted.

    It is the counterpart of `deltalight.protocol.receiver.Receiver`, whose newest message wins. `topics` are stream
    names (`color`); subscriptions are sent in their order. `keys` are required if an endpoint leaves the host.

    Raises:
        DeltalightError: an endpoint leaves the host without keys, or is malformed.
    """

    def __init__(self, endpoints: Sequence[str], topics: Sequence[str], keys: Keys | None = None) -> None:
        self._messages: deque[ReceivedMultipart] = deque()
        self._held: Counter[str] = Counter()
        self._held_bytes = 0
        self._drops: Counter[str] = Counter()
        subscriptions = [topic + "." for topic in topics]
        super().__init__(endpoints, subscriptions, keys=keys, high_water_mark=QUEUED_MESSAGES)

    def take(self, timeout_s: float) -> ReceivedMultipart | None:
        """Returns the oldest message; None if there was none within `timeout_s` seconds."""
        with self._changed:
            self._changed.wait_for(lambda: self._messages or self._closed, timeout_s)
            if not self._messages:
                return None
            message = self._messages.popleft()
            self._held[_stream(message)] -= 1
            self._held_bytes -= _size(message)
        return message

    @property
    def drops(self) -> dict[str, int]:
        """Number of messages of each stream that found the queue full."""
        with self._changed:
            return dict(self._drops)

    def _store(self, message: ReceivedMultipart) -> None:
        if len(message) > MAX_PARTS + 2 or len(message[0]) > MAX_TOPIC_BYTES:
            return  # not a message of the wire
        stream, size = _stream(message), _size(message)
        with self._changed:
            if self._held[stream] >= QUEUED_MESSAGES or self._held_bytes + size > QUEUED_BYTES:
                self._drops[stream] += 1
                return
            self._messages.append(message)
            self._held[stream] += 1
            self._held_bytes += size
            self._changed.notify()


def _stream(message: ReceivedMultipart) -> str:
    """Returns the stream of a message; subscriptions end in a dot, so every topic has one."""
    return bytes(message[0]).partition(b".")[0].decode("ascii", errors="replace")


def _size(message: ReceivedMultipart) -> int:
    return sum(piece.nbytes for piece in message)
