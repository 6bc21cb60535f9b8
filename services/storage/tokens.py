"""Tokens of the REST API: shown once, stored as a salted SHA-256 hash.

A slow hash protects passwords that people choose; nobody guesses a secret of 256 random bits.
"""

import hashlib
import hmac
import re
import secrets
import time
from dataclasses import dataclass
from typing import Literal

from sqlalchemy import func, select

from deltalight.protocol.errors import DeltalightError
from deltalight.services.storage.database import Database, remembered
from deltalight.services.storage.faults import ConflictError, NotFoundError, OutdatedTokenError
from deltalight.services.storage.tables import TokenRow

Role = Literal["view", "control"]
PREFIX = "deltalight"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_TOKEN = re.compile(PREFIX + r"-([0-9a-f]{12})-([A-Za-z0-9_-]{43})")
_SALT_BYTES, _SECRET_BYTES = 16, 32


@dataclass(frozen=True)
class Token:
    """Metadata of a token, without the token itself."""

    id: str
    name: str
    role: Role
    created_ns: int


class TokenStore:
    """The tokens of a store."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(self, name: str, role: Role) -> str:
        """Creates a token and returns it; it cannot be shown again.

        Raises:
            DeltalightError: the name is wrong or taken.
        """
        if not _NAME.fullmatch(name):
            raise DeltalightError(
                f"`{name}` is not a valid name for a token; use letters, digits, dots and dashes."
            )
        token_id, secret, salt = (
            secrets.token_hex(6),
            secrets.token_urlsafe(_SECRET_BYTES),
            secrets.token_bytes(_SALT_BYTES),
        )
        with self._database.writing() as session:
            if session.scalars(select(TokenRow).where(TokenRow.name == name)).first() is not None:
                raise ConflictError(
                    f"there is a token called `{name}`; revoke it first or choose another name."
                )
            session.add(
                TokenRow(
                    id=token_id,
                    name=name,
                    role=role,
                    salt=salt,
                    hash=_hash(secret, salt),
                    created_ns=time.time_ns(),
                )
            )
        return f"{PREFIX}-{token_id}-{secret}"

    @remembered
    def all(self) -> list[Token]:
        """Returns all tokens, in the order of their creation."""
        with self._database.reading() as session:
            return [_token(row) for row in session.scalars(select(TokenRow).order_by(TokenRow.created_ns))]

    @property
    @remembered
    def is_empty(self) -> bool:
        """Whether there is no token at all."""
        with self._database.reading() as session:
            return session.scalars(select(func.count()).select_from(TokenRow)).one() == 0

    def revoke(self, name: str) -> None:
        """Revokes a token; it is refused from the next request on.

        Raises:
            NotFoundError: there is no token of this name.
        """
        with self._database.writing() as session:
            row = session.scalars(select(TokenRow).where(TokenRow.name == name)).first()
            if row is None:
                raise NotFoundError(f"there is no token called `{name}`; list the tokens for their names.")
            session.delete(row)

    def knows(self, token_id: str) -> bool:
        """Whether a token of this id still exists; where the database is away, whether `verify` found it last."""
        return self._row(token_id) is not None

    def verify(self, token: str) -> Token | None:
        """Returns the metadata of a token, None if it is not valid.

        Raises:
            OutdatedTokenError: it is stored in the way of an earlier version.
        """
        match = _TOKEN.fullmatch(token)
        if match is None:
            return None
        token_id, secret = match.groups()
        row = self._row(token_id)
        if row is None:
            return None
        given = _hash(secret, row.salt)
        if len(row.hash) != len(given):
            raise OutdatedTokenError(
                "The token was made by an earlier version; revoke it and make another with "
                "`deltalight api token NAME`."
            )
        return _token(row) if hmac.compare_digest(row.hash, given) else None

    @remembered
    def _row(self, token_id: str) -> TokenRow | None:
        with self._database.reading() as session:
            return session.get(TokenRow, token_id)


def _hash(secret: str, salt: bytes) -> bytes:
    return hashlib.sha256(salt + secret.encode()).digest()


def role_named(stored: str) -> Role:
    """Returns the role that the database names."""
    return "control" if stored == "control" else "view"


def _token(row: TokenRow) -> Token:
    return Token(row.id, row.name, role_named(row.role), row.created_ns)
