"""Memory that many viewers needed at once goes back to the kernel after they have left."""

import asyncio
import threading

from deltalight.render_server.freed_memory import give_back_freed_memory

MANY_STREAMS = 32
DELAY_S = 10.0  # others end meanwhile, and whoever comes and goes without end causes one return in so long


class MemoryReturn:
    """Gives free memory back some time after `MANY_STREAMS` streams have ended (one event loop)."""

    def __init__(self) -> None:
        self._ended = 0
        self._due: asyncio.TimerHandle | None = None

    def note_ended(self) -> None:
        """Counts a stream that has ended."""
        self._ended += 1
        if self._ended >= MANY_STREAMS and self._due is None:
            self._due = asyncio.get_running_loop().call_later(DELAY_S, self._start)

    def _start(self) -> None:
        self._ended, self._due = 0, None
        threading.Thread(target=give_back_freed_memory, name="memory", daemon=True).start()
