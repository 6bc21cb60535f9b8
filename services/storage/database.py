"""The SQLite file: in WAL mode, written in transactions that are durable when they end."""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlalchemy import URL, Connection, create_engine, event
from sqlalchemy.exc import DatabaseError, IntegrityError
from sqlalchemy.orm import Session
from sqlalchemy.pool import ConnectionPoolEntry

from deltalight.protocol.errors import DeltalightError
from deltalight.services.storage.faults import StorageFaultError
from deltalight.services.storage.tables import MIGRATIONS, SCHEMA_VERSION, Base

BUSY_TIMEOUT_S = 10.0
_IMMEDIATE = "deltalight_immediate"
_DAMAGED = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


class Database:
    """A database file, shared by any number of threads and processes.

    A file of an older version is migrated in one transaction.

    Raises:
        DeltalightError: the file is of a newer version, no database, or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        url = URL.create("sqlite", database=str(path))
        self._engine = create_engine(url, connect_args={"timeout": BUSY_TIMEOUT_S})
        event.listen(self._engine, "connect", _prepare)
        event.listen(self._engine, "begin", _begin)
        self._writing = self._engine.execution_options(**{_IMMEDIATE: True})
        with self._explained(), self._engine.connect() as connection:
            driver = connection.connection.driver_connection
            assert driver is not None
            driver.execute("PRAGMA journal_mode=WAL")
        self._create_tables()

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """Yield a session with a consistent view of the data."""
        with self._explained(), Session(self._engine) as session:
            yield session

    @contextmanager
    def writing(self) -> Iterator[Session]:
        """Yield the session of the only writer, of all threads and processes; an exception rolls everything back."""
        with self._explained(), Session(self._writing) as session, session.begin():
            yield session

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()

    def _create_tables(self) -> None:
        with self._explained(), self._writing.begin() as connection:
            version = connection.exec_driver_sql("PRAGMA user_version").scalar_one()
            if version == 0:
                Base.metadata.create_all(connection)
            elif not 0 < version <= SCHEMA_VERSION:
                raise DeltalightError(
                    f"{self._path} was written by another version of Deltalight (its layout is {version}, this one "
                    f"reads {SCHEMA_VERSION}); start the version that wrote it, or name another --data folder."
                )
            for older in range(version or SCHEMA_VERSION, SCHEMA_VERSION):
                for statement in MIGRATIONS[older]:
                    connection.exec_driver_sql(statement)
            connection.exec_driver_sql(f"PRAGMA user_version={SCHEMA_VERSION}")

    @contextmanager
    def _explained(self) -> Iterator[None]:
        try:
            yield
        except IntegrityError:  # a fault of this program, not of the disk
            raise
        except (DatabaseError, sqlite3.DatabaseError) as fault:
            cause = fault.orig if isinstance(fault, DatabaseError) else fault
            if getattr(cause, "sqlite_errorcode", 0) & 0xFF in _DAMAGED:
                raise StorageFaultError(
                    f"{self._path} is damaged ({cause}); end the service and run `deltalight restore BACKUP`."
                ) from fault
            raise StorageFaultError(
                f"The database cannot be used now ({cause}); free some space, end other users of it, or name "
                "another --data folder."
            ) from fault


def _prepare(connection: sqlite3.Connection, _entry: ConnectionPoolEntry) -> None:
    """Leave transactions to this class, and make each durable (WAL alone survives a kill, but no power cut)."""
    connection.isolation_level = None
    connection.execute("PRAGMA synchronous=FULL")
    connection.execute("PRAGMA foreign_keys=ON")


def _begin(connection: Connection) -> None:
    """Lock at the start of a writer, so that what it reads stays true until it has written."""
    immediate = connection.get_execution_options().get(_IMMEDIATE, False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if immediate else "BEGIN")
