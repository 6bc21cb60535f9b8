"""Receiver of streams: keeps the newest message of each topic."""

from collections import Counter
from collections.abc import Sequence

from deltalight.protocol.envelope import MAX_PARTS, MAX_TOPIC_BYTES
from deltalight.protocol.keys import Keys
from deltalight.protocol.subscriber import ReceivedMultipart, Subscriber

MAX_TOPICS = 256
MAX_WAITING_BYTES = 1 << 30  # of all topics together: sixteen of the largest pictures


class Receiver(Subscriber):
    """Mailbox with one slot per topic: the newest message wins, and replaced ones are counted.

    The thread empties the socket at once: a slow consumer gets new frames instead of a queue of old ones. `topics`
    are stream names (`color`) or whole topics (`color.desk`); an empty list means everything. `keys` are required if
    an endpoint leaves the host.
    """

    def __init__(
        self,
        endpoints: Sequence[str],
        topics: Sequence[str],
        *,
        bind: bool = False,
        keys: Keys | None = None,
    ) -> None:
        self._topics = tuple(topics)
        self._slots: dict[str, ReceivedMultipart] = {}
        self._waiting_bytes = 0
        self._drops: Counter[str] = Counter()
        self._refused = 0
        self._seen: set[str] = set()
        super().__init__(endpoints, self._topics or ("",), bind=bind, keys=keys)

    def latest(self, timeout_s: float) -> dict[str, ReceivedMultipart] | None:
        """Takes the newest message of every topic that has one, by topic.

        Waits for a message; returns None after `timeout_s` seconds without any, or when the receiver is closed.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._slots or self._closed, timeout_s)
            taken, self._slots, self._waiting_bytes = self._slots, {}, 0
        return taken or None

    @property
    def drops(self) -> dict[str, int]:
        """Number of messages of each topic that a newer one replaced before they were taken.

        `not_allowed` is the number of those that a trusted host may not send.
        """
        refused = {"not_allowed": self.not_allowed} if self.not_allowed else {}
        with self._changed:
            return {**self._drops, **refused}

    @property
    def refused(self) -> int:
        """Number of messages dropped for an unreadable topic, too many parts, or one topic or byte too many."""
        return self._refused

    def _store(self, message: ReceivedMultipart) -> None:
        topic = bytes(message[0][: MAX_TOPIC_BYTES + 1]).decode("ascii", errors="replace")
        if not self._accepts(topic, len(message)):
            self._refused += 1
            return
        with self._changed:
            waiting = self._waiting_bytes + _size(message) - _size(self._slots.get(topic, ()))
            if waiting > MAX_WAITING_BYTES:
                self._refused += 1
                return
            if topic in self._slots:
                self._drops[topic] += 1
            self._slots[topic], self._waiting_bytes = message, waiting
            self._changed.notify()

    def _accepts(self, topic: str, pieces: int) -> bool:
        """Whether a message is wanted: subscriptions are prefixes, so `color.a` also matches `color.ab`."""
        if not topic.isascii() or len(topic) > MAX_TOPIC_BYTES or pieces > MAX_PARTS + 2:
            return False
        if self._topics and not any(topic == wish or topic.startswith(wish + ".") for wish in self._topics):
            return False
        if topic not in self._seen and len(self._seen) >= MAX_TOPICS:
            return False
        self._seen.add(topic)
        return True


def _size(message: Sequence[memoryview]) -> int:
    return sum(piece.nbytes for piece in message)
