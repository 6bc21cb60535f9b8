"""A PostgreSQL database: several web processes share it, on any hosts."""

import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any, TypeVar

import psycopg
import structlog
from sqlalchemy import URL, Connection, create_engine, event, make_url
from sqlalchemy.exc import ArgumentError, DataError, DBAPIError, IntegrityError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from sqlalchemy.pool import ConnectionPoolEntry

from deltalight.protocol.errors import DeltalightError
from deltalight.services.storage.database import BUSY_TIMEOUT_S, IS_DURABLE, WRITES, Database
from deltalight.services.storage.faults import DatabaseGoneError, StorageFaultError
from deltalight.services.storage.feed import Feed
from deltalight.services.storage.feed_notify import NotifyFeed
from deltalight.services.storage.last_known import LastKnown
from deltalight.services.storage.schema import stored_version
from deltalight.services.storage.timed_connection import TimedConnection

WRITER_LOCK = 0x64656C74616C6967  # of pg_advisory_xact_lock: "deltalig"
CONNECTIONS = 16
TRY_AGAIN_S = 0.5  # after it did not answer; meanwhile nobody waits for it
# A host that vanishes is noticed within seconds, not after the system's two hours.
CONNECTION_OPTIONS: dict[str, Any] = {
    "connect_timeout": 3,
    "keepalives_idle": 5,
    "keepalives_interval": 2,
    "keepalives_count": 3,
    "tcp_user_timeout": 10_000,
}
GONE = "The database does not answer; what is known of it can be read, and changes can be made once it runs again."
Answer = TypeVar("Answer")

log = structlog.get_logger()


class PostgresDatabase(Database):
    """A database at an address `postgresql://USER@HOST/NAME`; writers take turns by an advisory lock.

    While it does not answer, reads have the answers of last time. Whoever asks it then fails at once, except for one
    at a time, who tries again.
    """

    def __init__(self, address: str) -> None:
        self._try_again_s = 0.0  # nobody tries before
        self._trial = Lock()
        self._is_gone = False
        self._is_open = False
        self._last = LastKnown()
        url = _parsed(address)
        given = url.normalized_query
        engine = create_engine(
            url,
            connect_args={name: value for name, value in CONNECTION_OPTIONS.items() if name not in given},
            pool_pre_ping=True,
            pool_size=CONNECTIONS,
            max_overflow=0,
            pool_timeout=BUSY_TIMEOUT_S,
        )
        super().__init__(engine, url.set(drivername="postgresql").render_as_string(hide_password=True))
        event.listen(engine, "do_connect", self._connect)
        event.listen(engine, "connect", _prepare)
        self._reading = engine.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)
        self._open()
        self._is_open = True
        engine.dispose()  # of the connection that may have changed the layout, which takes its time

    def answer(self, key: Hashable, read: Callable[[], Answer]) -> Answer:
        """Returns what `read` returns; while the database is away, what it returned last time under this `key`."""
        return self._last.answer(key, read)

    def note(self, key: Hashable, answer: Answer, read: Callable[[], Answer]) -> None:
        """Notes what `read` would answer now, after a change."""
        self._last.note(key, answer, read)

    def keep_known(self, *reads: Callable[[], object]) -> None:
        """Makes these reads now and after each change, so that their answers are known if the database goes."""
        self._last.keep(*reads)

    def feed(self) -> Feed:
        """Returns a feed to and from the other processes that use this database."""
        return NotifyFeed(self._engine, self._explained, self._last.tick)

    def _version(self, connection: Connection) -> int:
        return stored_version(connection)

    def _begin(self, connection: Connection) -> None:
        if self._is_gone:  # it was asked whether it is there, or has accepted the connection
            self._is_gone = False
            log.info("the database answers again")
        options = connection.get_execution_options()
        if options.get(WRITES, False):
            if not options.get(IS_DURABLE, True):
                connection.exec_driver_sql("SET LOCAL synchronous_commit = off")
            connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({WRITER_LOCK})")

    def _connect(
        self, _dialect: object, _entry: object, args: list[Any], options: dict[str, Any]
    ) -> TimedConnection:
        connection = TimedConnection.connect(*args, **options)
        connection.is_timed = self._is_open
        return connection

    @contextmanager
    def _explained(self) -> Iterator[None]:
        with self._in_turn(), self._in_sentences():
            yield

    @contextmanager
    def _in_turn(self) -> Iterator[None]:
        """While it is away, let nobody try soon after a trial, or beside another one."""
        if time.monotonic() < self._try_again_s:
            raise DatabaseGoneError(GONE)
        if not self._is_gone:
            yield
        elif self._trial.acquire(blocking=False):
            try:
                yield
            finally:
                self._trial.release()
        else:
            raise DatabaseGoneError(GONE)

    @contextmanager
    def _in_sentences(self) -> Iterator[None]:
        try:
            yield
        except IntegrityError:  # a fault of this program, not of the database
            raise
        except DataError as fault:
            raise DeltalightError(
                f"The database cannot keep this ({_first_line(fault)}); remove NUL characters from its texts."
            ) from fault
        except DBAPIError as fault:
            if not _is_gone(fault):
                raise StorageFaultError(
                    f"The database cannot be used now ({_first_line(fault)}); try again, or check its server."
                ) from fault
            raise self._gone_error(fault) from fault
        except PoolTimeoutError as fault:
            raise StorageFaultError("Too many requests wait for the database; try again soon.") from fault

    def _gone_error(self, fault: DBAPIError) -> DatabaseGoneError:
        """Returns the error for clients, who need not know where the database is; that is in the log, once."""
        if not self._is_open:
            return DatabaseGoneError(
                f"The database {self.shown} does not answer ({_first_line(fault)}); start it, or correct its address."
            )
        if not self._is_gone:
            log.warning("the database does not answer", database=self.shown, fault=_first_line(fault))
        self._is_gone = True
        if not fault.connection_invalidated:  # no connection could be made
            self._try_again_s = time.monotonic() + TRY_AGAIN_S
        return DatabaseGoneError(GONE)


def _parsed(address: str) -> URL:
    try:
        url = make_url(address)
    except (ArgumentError, ValueError) as fault:
        raise DeltalightError(_WRONG_ADDRESS) from fault
    if url.drivername not in ("postgresql", "postgres", "postgresql+psycopg") or not url.database:
        raise DeltalightError(_WRONG_ADDRESS)
    return url.set(drivername="postgresql+psycopg")


_WRONG_ADDRESS = "the address of a database must be that of PostgreSQL, such as postgresql://USER@HOST/NAME."


def _prepare(connection: psycopg.Connection[Any], _entry: ConnectionPoolEntry) -> None:
    """Waits for other writers no longer than for those of SQLite."""
    connection.autocommit = True
    connection.execute(f"SET lock_timeout = '{BUSY_TIMEOUT_S:.0f}s'")
    connection.autocommit = False


def _is_gone(fault: DBAPIError) -> bool:
    """Whether the connection was lost or not made: without a code of the server, or by one of classes 08 and 57P.

    https://www.postgresql.org/docs/15/errcodes-appendix.html
    """
    code = getattr(fault.orig, "sqlstate", None)
    return fault.connection_invalidated or code is None or code.startswith(("08", "57P"))


def _first_line(fault: DBAPIError) -> str:
    return str(fault.orig).strip().splitlines()[0].strip().rstrip(".")
