"""The sender of a request and its credentials: a token of the store, a token from a file, or a ticket."""

import hashlib
import hmac
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from starlette.types import Scope

from deltalight.protocol.errors import DeltalightError
from deltalight.services.storage.faults import StorageFaultError
from deltalight.services.storage.tickets import Ticket, TicketStore
from deltalight.services.storage.tokens import Role

TICKET_LIFE_S = 30.0
OPEN_TICKETS = 4096  # beyond these, the oldest one expires
_TICKET_BYTES = 32
SHORTEST, LONGEST = 32, 512  # characters of a token in a file; 32 hex digits are 128 bits
SECRET_NAME = "token file"
_KEY = "deltalight.principal"


@dataclass(frozen=True)
class Principal:
    """The sender of a request and its role; `token_id` is None if no token was required."""

    role: Role
    token_id: str | None = None
    name: str = ""


def set_principal(scope: Scope, principal: Principal) -> None:
    """Attaches the authenticated principal to a request."""
    scope[_KEY] = principal


def principal_of(scope: Scope) -> Principal:
    """Returns the principal that the middleware attached to a request."""
    principal = scope[_KEY]
    assert isinstance(principal, Principal)
    return principal


class SecretToken:
    """A token in a file, as container engines and systemd provide secrets.

    Tokens are compared by their hashes in constant time.
    """

    def __init__(self, path: Path, role: Role = "control") -> None:
        self._role: Role = role
        try:
            token = path.read_text(encoding="ascii").strip()
        except (OSError, UnicodeDecodeError) as fault:
            raise DeltalightError(
                f"the token file {path} cannot be read as text; give one that can."
            ) from fault
        if not SHORTEST <= len(token) <= LONGEST or not token.isprintable() or " " in token:
            raise DeltalightError(
                f"the token file {path} must hold one word of {SHORTEST} to {LONGEST} characters; make one with "
                "`openssl rand -hex 32`."
            )
        self._hash = _hash(token)

    def verify(self, given: str) -> Principal | None:
        """Returns the principal of this token, or None if it is not the file's."""
        is_equal = hmac.compare_digest(self._hash, _hash(given))
        return Principal(self._role, name=SECRET_NAME) if is_equal else None


def _hash(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).digest()


class Tickets:
    """Single-use tickets for addresses that cannot carry a token: WebSockets and pictures in a browser.

    A ticket admits once, with the role of the principal that requested it. With a `store`, every web process of its
    database takes it; while that does not answer, this one alone.
    """

    def __init__(
        self, clock_s: Callable[[], float] = time.monotonic, store: TicketStore | None = None
    ) -> None:
        self._clock_s = clock_s
        self._store = store
        self._open: OrderedDict[str, _Ticket] = OrderedDict()
        self._lock = threading.Lock()

    def issue(self, principal: Principal) -> str:
        """Creates a ticket for this principal."""
        ticket = secrets.token_urlsafe(_TICKET_BYTES)
        if self._store is not None:
            with suppress(StorageFaultError):
                shown = Ticket(principal.role, principal.token_id, principal.name)
                self._store.add(ticket, shown, TICKET_LIFE_S)
                return ticket
        with self._lock:
            self._open[ticket] = _Ticket(principal, self._clock_s() + TICKET_LIFE_S)
            while len(self._open) > OPEN_TICKETS:
                self._open.popitem(last=False)
        return ticket

    def redeem(self, ticket: str) -> Principal | None:
        """Consumes a ticket and returns its principal, or None if it is unknown or has expired.

        Raises:
            StorageFaultError: the store does not answer.
        """
        with self._lock:
            found = self._open.pop(ticket, None)
        if found is None and self._store is not None:
            taken = self._store.take(ticket)
            return None if taken is None else Principal(taken.role, taken.token_id, taken.name)
        return None if found is None or found.ends_s < self._clock_s() else found.principal


@dataclass(frozen=True)
class _Ticket:
    principal: Principal
    ends_s: float
