"""A lock that threads get in the order in which they came."""

import threading
from collections import deque


class Turns:
    """One thread at a time, in the order of arrival.

    `threading.Lock` lets the thread that has just left in again before those that wait.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._is_taken = False
        self._waiting: deque[threading.Lock] = deque()

    def __enter__(self) -> None:
        """Wait for this thread's turn."""
        with self._lock:
            if not self._is_taken:
                self._is_taken = True
                return
            turn = threading.Lock()
            turn.acquire()
            self._waiting.append(turn)
        turn.acquire()

    def __exit__(self, *_fault: object) -> None:
        """Hand over to who has waited longest."""
        with self._lock:
            if self._waiting:
                self._waiting.popleft().release()
            else:
                self._is_taken = False
