"""What the web process that records and replays does, for the others of the database, which hear its events."""

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

LIFE_S = 6.0  # a recording is reported once a second, a replay every two: who is silent for longer was killed


class HeardJobs:
    """The newest events about recordings in progress and about the replay, as long as they are repeated."""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._recordings: dict[str, tuple[float, Mapping[str, Any]]] = {}
        self._replay: tuple[float, Mapping[str, Any]] | None = None
        self._lock = threading.Lock()

    def hear(self, type: str, body: Mapping[str, Any]) -> None:
        """Notes an event of another web process (any thread)."""
        now_s = self._clock_s()
        with self._lock:
            if type == "replay":
                self._replay = now_s, body
            elif (
                type == "recording" and not body.get("deleted") and body["state"] in ("waiting", "recording")
            ):
                self._recordings[body["id"]] = now_s, body
            elif type == "recording":
                self._recordings.pop(body["id"], None)

    def growing(self) -> list[Mapping[str, Any]]:
        """Returns the recordings in progress, as events describe them."""
        since_s = self._clock_s() - LIFE_S
        with self._lock:
            self._recordings = {
                name: heard for name, heard in self._recordings.items() if heard[0] >= since_s
            }
            return [body for _, body in self._recordings.values()]

    def replay(self) -> Mapping[str, Any] | None:
        """Returns what is replayed and where, as events describe it; None = nobody says anything."""
        heard = self._replay
        return None if heard is None or heard[0] < self._clock_s() - LIFE_S else heard[1]
