"""What node and render server say about themselves once a second."""

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass

import structlog

from protocol.envelope import decode
from protocol.errors import DeltalightError
from protocol.keys import Keys
from protocol.messages import StatsMessage
from protocol.transport import ReceivedMultipart, Receiver

RECEIVE_TIMEOUT_S = 0.2
FORGOTTEN_AFTER_S = 3600.0

log = structlog.get_logger()


@dataclass(frozen=True)
class Report:
    """The newest report of a process, and when it came (monotonic seconds)."""

    message: StatsMessage
    received_s: float

    @property
    def age_s(self) -> float:
        """Seconds since it came."""
        return time.monotonic() - self.received_s


class ProcessWatch:
    """Keeps the newest report of every process that publishes at one of the endpoints."""

    def __init__(self, endpoints: Sequence[str], keys: Keys | None = None) -> None:
        self._receiver = Receiver(endpoints, ["stats"], keys=keys)
        self._reports: dict[str, Report] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="process-watch", daemon=True)

    def start(self) -> None:
        """Begin to listen."""
        self._thread.start()

    def close(self) -> None:
        """Stop listening."""
        self._stop.set()
        self._receiver.close()
        if self._thread.is_alive():
            self._thread.join()

    def reports(self) -> list[Report]:
        """Newest report of each process, by name."""
        with self._lock:
            self._reports = {k: v for k, v in self._reports.items() if v.age_s < FORGOTTEN_AFTER_S}
            return [self._reports[name] for name in sorted(self._reports)]

    def _run(self) -> None:
        while not self._stop.is_set():
            for multipart in (self._receiver.latest(RECEIVE_TIMEOUT_S) or {}).values():
                self._note(multipart)

    def _note(self, multipart: ReceivedMultipart) -> None:
        try:
            message, _ = decode(multipart)
        except DeltalightError as fault:
            log.warning("report not understood", fault=str(fault))
            return
        if isinstance(message, StatsMessage):
            with self._lock:
                self._reports[message.node] = Report(message, time.monotonic())
