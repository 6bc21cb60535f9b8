"""Single-use tickets of the REST API, which any of several web processes takes; stored as their SHA-256."""

import hashlib
import time
from dataclasses import dataclass

from sqlalchemy import delete

from deltalight.services.storage.database import Database
from deltalight.services.storage.tables import TicketRow
from deltalight.services.storage.tokens import Role, role_named


@dataclass(frozen=True)
class Ticket:
    """Whom a ticket admits: the role, and the token that it was requested with."""

    role: Role
    token_id: str | None
    name: str


class TicketStore:
    """The tickets of a store."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, secret: str, ticket: Ticket, life_s: float) -> None:
        """Stores a ticket until it is taken, or its life ends."""
        now_ns = time.time_ns()
        with self._database.writing(durable=False) as session:  # it need not survive a power cut
            session.execute(delete(TicketRow).where(TicketRow.ends_ns < now_ns))
            session.add(
                TicketRow(
                    hash=_hash(secret),
                    role=ticket.role,
                    token_id=ticket.token_id,
                    name=ticket.name,
                    ends_ns=now_ns + round(life_s * 1e9),
                )
            )

    def take(self, secret: str) -> Ticket | None:
        """Removes a ticket and returns it; None if it is unknown, used or has expired."""
        with self._database.reading() as session:
            if session.get(TicketRow, _hash(secret)) is None:  # who guesses does not keep writers waiting
                return None
        with self._database.writing(durable=False) as session:
            row = session.get(TicketRow, _hash(secret))
            if row is None:
                return None
            session.delete(row)
            is_valid = row.ends_ns >= time.time_ns()
            return Ticket(role_named(row.role), row.token_id, row.name) if is_valid else None


def _hash(secret: str) -> bytes:
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).digest()
