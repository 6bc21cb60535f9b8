"""Repeats messages of long-lived content, because a PUB socket stores nothing for late subscribers."""

import time
from collections.abc import Callable
from typing import Generic, TypeVar

# A late subscriber has the light after this time; at 1 MB per map it costs less than one stream of pictures.
REPEAT_S = 2.0

Item = TypeVar("Item")


class Repeater(Generic[Item]):
    """Sends one kind of message: when its object is new, and then unchanged every REPEAT_S."""

    def __init__(self) -> None:
        self._item: Item | None = None
        self._multipart: list[bytes] = []
        self._sent_s = 0.0

    def send(self, item: Item, made: Callable[[], list[bytes]], send: Callable[[list[bytes]], None]) -> None:
        """Send the message of `item`, created by `made`, if it is due."""
        now_s = time.monotonic()
        if item is not self._item:
            self._item, self._multipart = item, made()
        elif now_s - self._sent_s < REPEAT_S:
            return
        send(self._multipart)
        self._sent_s = now_s
