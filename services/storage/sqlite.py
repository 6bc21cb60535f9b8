"""The SQLite file: in WAL mode, written in transactions that are durable when they end."""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlalchemy import URL, Connection, create_engine, event
from sqlalchemy.exc import DatabaseError, IntegrityError
from sqlalchemy.pool import ConnectionPoolEntry

from deltalight.services.storage.database import BUSY_TIMEOUT_S, IS_DURABLE, WRITES, Database
from deltalight.services.storage.faults import StorageFaultError
from deltalight.services.storage.feed import Feed
from deltalight.services.storage.feed_sockets import SocketFeed
from deltalight.services.storage.schema import FIRST_WITH_ALEMBIC, note_version
from deltalight.services.storage.tables import SCHEMA_VERSION

_DAMAGED = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


class SqliteDatabase(Database):
    """A database file; others in its folder use it together."""

    def __init__(self, path: Path) -> None:
        url = URL.create("sqlite", database=str(path))
        super().__init__(create_engine(url, connect_args={"timeout": BUSY_TIMEOUT_S}), str(path))
        self._path = path
        event.listen(self._engine, "connect", _prepare)
        with self._explained(), self._engine.connect() as connection:
            driver = connection.connection.driver_connection
            assert driver is not None
            driver.execute("PRAGMA journal_mode=WAL")
        self._open()

    def feed(self) -> Feed:
        """Returns a feed to and from the other processes of the folder."""
        return SocketFeed(self._path.parent)

    def _version(self, connection: Connection) -> int:
        """Returns the file's own number, by which versions without Alembic refuse it too."""
        return int(connection.exec_driver_sql("PRAGMA user_version").scalar_one())

    def _migrate(self, connection: Connection, version: int) -> None:
        if version < FIRST_WITH_ALEMBIC:
            note_version(connection, version)
        super()._migrate(connection, version)

    def _note_version(self, connection: Connection) -> None:
        connection.exec_driver_sql(f"PRAGMA user_version={SCHEMA_VERSION}")

    def _begin(self, connection: Connection) -> None:
        options = connection.get_execution_options()
        if not options.get(WRITES, False):
            connection.exec_driver_sql("BEGIN")
            return
        # WAL alone survives a kill, but no power cut.
        level = "FULL" if options.get(IS_DURABLE, True) else "NORMAL"
        connection.exec_driver_sql(f"PRAGMA synchronous={level}")
        connection.exec_driver_sql("BEGIN IMMEDIATE")

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
                    f"{self._path} is damaged ({cause}); stop the service and run `deltalight restore BACKUP`."
                ) from fault
            raise StorageFaultError(
                f"The database cannot be used now ({cause}); free some space, stop other programs that use it, or"
                " name another --data folder."
            ) from fault


def _prepare(connection: sqlite3.Connection, _entry: ConnectionPoolEntry) -> None:
    """Leaves transactions to this class."""
    connection.isolation_level = None
    connection.execute("PRAGMA foreign_keys=ON")
