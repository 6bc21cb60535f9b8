"""A database for scenes, assets and tokens: what SQLite and PostgreSQL have in common."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial, wraps
from typing import Concatenate, ParamSpec, Protocol, TypeVar

from sqlalchemy import Connection, Engine, event
from sqlalchemy.orm import Session

from deltalight.protocol.errors import DeltalightError
from deltalight.services.storage.feed import Feed
from deltalight.services.storage.schema import make_tables, migrate
from deltalight.services.storage.tables import SCHEMA_VERSION

BUSY_TIMEOUT_S = 10.0
WRITES, IS_DURABLE = "deltalight_writes", "deltalight_is_durable"  # execution options
Answer = TypeVar("Answer")
Given = ParamSpec("Given")


class Database(ABC):
    """A database, shared by any number of threads and processes; `shown` names it in sentences.

    One of an older version is migrated in one transaction.

    Raises:
        DeltalightError: it is of a newer version, no database, or cannot be used.
    """

    def __init__(self, engine: Engine, shown: str) -> None:
        self.shown = shown
        self._engine = engine
        self._reading = self._writing = engine

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """Yields a session with a consistent view of the data."""
        with self._explained(), Session(self._reading) as session:
            yield session

    @contextmanager
    def writing(self, *, durable: bool = True) -> Iterator[Session]:
        """Yields the session of the only writer, of all threads and processes; an exception rolls everything back.

        What is not `durable` may be lost in a power cut.
        """
        engine = self._writing if durable else self._writing.execution_options(**{IS_DURABLE: False})
        with self._explained(), Session(engine) as session, session.begin():
            yield session

    def answer(self, key: Hashable, read: Callable[[], Answer]) -> Answer:
        """Returns what `read` returns; where the database may be away, what it last returned under this `key`."""
        del key
        return read()

    def note(self, key: Hashable, answer: Answer, read: Callable[[], Answer]) -> None:
        """Notes what `read` would answer now, after a change."""
        del key, answer, read

    def keep_known(self, *reads: Callable[[], object]) -> None:
        """Has the answers of these reads at hand if the database goes."""
        del reads

    @abstractmethod
    def feed(self) -> Feed:
        """Returns a feed to and from the other processes that use this database; the caller closes it."""

    def close(self) -> None:
        """Closes all connections."""
        self._engine.dispose()

    def _open(self) -> None:
        """Locks writers' transactions from now on, and brings the layout up to date."""
        event.listen(self._engine, "begin", self._begin)
        self._writing = self._engine.execution_options(**{WRITES: True})
        with self._explained(), self._writing.begin() as connection:
            version = self._version(connection)
            if version > SCHEMA_VERSION or version < 0:
                raise DeltalightError(
                    f"{self.shown} was written by another version of Deltalight (its layout is {version}, this one "
                    f"reads {SCHEMA_VERSION}); start the version that wrote it, or name another --data folder."
                )
            if version == 0:
                make_tables(connection)
            elif version < SCHEMA_VERSION:
                self._migrate(connection, version)
            self._note_version(connection)

    @abstractmethod
    def _version(self, connection: Connection) -> int:
        """Returns the version of the layout; 0 = there are no tables."""

    def _migrate(self, connection: Connection, version: int) -> None:
        """Brings an older layout up to date."""
        del version
        migrate(connection)

    def _note_version(self, connection: Connection) -> None:
        """Notes where else than in Alembic's table that the layout is the newest."""
        del connection

    @abstractmethod
    def _begin(self, connection: Connection) -> None:
        """Locks at the start of a writer, so that what it reads stays true until it has written."""

    @abstractmethod
    def _explained(self) -> AbstractContextManager[None]:
        """Turns faults of the database into sentences."""


class Stored(Protocol):
    """What reads a database."""

    _database: Database


Reader = TypeVar("Reader", bound=Stored)


def remembered(
    read: Callable[Concatenate[Reader, Given], Answer],
) -> Callable[Concatenate[Reader, Given], Answer]:
    """Lets a method that reads answer as last time while the database is away (`Database.answer`)."""

    @wraps(read)
    def answer(self: Reader, /, *args: Given.args, **kwargs: Given.kwargs) -> Answer:
        key = (read.__qualname__, self, args, tuple(sorted(kwargs.items())))
        return self._database.answer(key, partial(read, self, *args, **kwargs))

    return answer
