"""A feed between the processes that use one database: short texts, none of which is kept."""

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable

import structlog

LONGEST_BYTES = 7900  # PostgreSQL takes less than 8000

log = structlog.get_logger()


class Feed(ABC):
    """Passes texts to all other processes, and theirs to `hear`, in a thread of its own.

    A process that cannot be reached misses them; `missed` is called where that was this one.
    """

    def __init__(self) -> None:
        self._hear: Callable[[str], None] = lambda _text: None
        self._missed: Callable[[], None] = lambda: None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="feed", daemon=True)

    def start(self, hear: Callable[[str], None], missed: Callable[[], None]) -> None:
        """Begins to hear."""
        self._hear, self._missed = hear, missed
        self._thread.start()

    def send(self, text: str) -> None:
        """Passes a text on soon (any thread); waits for nothing."""
        content = text.encode()
        if len(content) > LONGEST_BYTES:
            log.warning("an event is too long to be passed to other web processes", bytes=len(content))
        else:
            self._send(content)

    def close(self) -> None:
        """Stops."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    @abstractmethod
    def _send(self, content: bytes) -> None:
        """Passes a text of at most `LONGEST_BYTES` on."""

    @abstractmethod
    def _run(self) -> None:
        """Hears until `_stop` is set."""

    def _pass_on(self, text: str) -> None:
        try:
            self._hear(text)
        except Exception:  # the next one must still be heard
            log.exception("an event of another web process was lost")
