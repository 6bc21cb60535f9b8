"""The feed of a PostgreSQL database: NOTIFY and LISTEN."""

import queue
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from typing import Any, Protocol
from uuid import uuid4

import psycopg
import structlog
from sqlalchemy import Connection, Engine, text

from deltalight.services.storage.faults import StorageFaultError
from deltalight.services.storage.feed import Feed

CHANNEL = "deltalight"
MOST_WAITING = 1024
LOOK_S = 0.2  # how soon the end is noticed
TRY_AGAIN_S = 0.5

log = structlog.get_logger()


class Tick(Protocol):
    """Called a few times a second."""

    def __call__(self, *, is_changed: bool) -> None:
        """Does what is due."""


class NotifyFeed(Feed):
    """Sends texts as notifications, and hears those of the others.

    `explained` turns faults of the database into sentences; `tick` is called a few times a second, with whether any
    text came, also from itself.
    """

    def __init__(
        self,
        engine: Engine,
        explained: Callable[[], AbstractContextManager[None]],
        tick: Tick,
    ) -> None:
        super().__init__()
        self._tick = tick
        self._engine = engine.execution_options(isolation_level="AUTOCOMMIT")
        self._explained = explained
        self._name = uuid4().hex[:16]
        self._waiting: queue.Queue[str] = queue.Queue(MOST_WAITING)
        self._sending = threading.Thread(target=self._send_all, name="feed-send", daemon=True)

    def start(self, hear: Callable[[str], None], missed: Callable[[], None]) -> None:
        """Begins to hear and to send."""
        super().start(hear, missed)
        self._sending.start()

    def _send(self, content: bytes) -> None:
        """Passes a text on soon; while the database is away it is lost."""
        try:
            self._waiting.put_nowait(self._name + content.decode())
        except queue.Full:
            log.warning("the database is too slow to pass events to other web processes; one is lost")

    def close(self) -> None:
        """Stops, once what waits was sent."""
        super().close()
        if self._sending.is_alive():
            self._sending.join()

    def _send_all(self) -> None:
        while not (self._stop.is_set() and self._waiting.empty()):
            try:
                payload = self._waiting.get(timeout=LOOK_S)
            except queue.Empty:
                continue
            try:
                with self._explained(), self._engine.connect() as connection:
                    connection.execute(
                        text("SELECT pg_notify(:channel, :payload)"),
                        {"channel": CHANNEL, "payload": payload},
                    )
            except StorageFaultError as fault:
                log.debug("an event was not passed to other web processes", fault=str(fault))

    def _run(self) -> None:
        has_listened = False
        while not self._stop.is_set():
            try:
                with ExitStack() as stack:
                    connection = self._listening(stack)
                    if has_listened:
                        self._missed()
                        self._tick(is_changed=True)
                    has_listened = True
                    self._listen(connection)
                    with self._explained():
                        connection.exec_driver_sql(f"UNLISTEN {CHANNEL}")
            except (StorageFaultError, psycopg.Error) as fault:
                log.debug("events of other web processes are not heard now", fault=str(fault).strip())
                self._stop.wait(TRY_AGAIN_S)

    def _listening(self, stack: ExitStack) -> Connection:
        """Returns a connection that hears, until the `stack` unwinds; that it hears nothing is no fault."""
        with self._explained():
            connection = stack.enter_context(self._engine.connect())
            connection.exec_driver_sql(f"LISTEN {CHANNEL}")
        return connection

    def _listen(self, connection: Connection) -> None:
        driver = connection.connection.driver_connection
        assert isinstance(driver, psycopg.Connection)
        try:
            while not self._stop.is_set():
                self._tick(is_changed=self._hear_all(driver))
        except psycopg.Error as fault:
            connection.invalidate(fault)
            raise

    def _hear_all(self, driver: psycopg.Connection[Any]) -> bool:
        """Passes on what comes within a moment; returns whether anything did, also from this process."""
        is_changed = False
        for found in driver.notifies(timeout=LOOK_S):
            is_changed = True
            sender, payload = found.payload[: len(self._name)], found.payload[len(self._name) :]
            if sender != self._name:
                self._pass_on(payload)
        return is_changed
