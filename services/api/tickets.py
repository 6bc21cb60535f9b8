"""Tickets: what a browser puts into the address of a WebSocket or a picture, where it cannot send its token."""

import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from services.api.passes import Pass

TICKET_LIFE_S = 30.0
OPEN_TICKETS = 4096  # the oldest of more is forgotten
_TICKET_BYTES = 32


class TicketBox:
    """Tickets that were given and not used yet; each lets in once, with the rights of who asked for it."""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._open: OrderedDict[str, _Ticket] = OrderedDict()
        self._lock = threading.Lock()

    def give(self, rights: Pass) -> str:
        """A new ticket with these rights."""
        ticket = secrets.token_urlsafe(_TICKET_BYTES)
        with self._lock:
            self._open[ticket] = _Ticket(rights, self._clock_s() + TICKET_LIFE_S)
            while len(self._open) > OPEN_TICKETS:
                self._open.popitem(last=False)
        return ticket

    def take(self, ticket: str) -> Pass | None:
        """The rights of a ticket, which is used up by this; None where there is no such ticket any more."""
        with self._lock:
            found = self._open.pop(ticket, None)
        return None if found is None or found.ends_s < self._clock_s() else found.rights


@dataclass(frozen=True)
class _Ticket:
    rights: Pass
    ends_s: float
