"""What node and render server say about themselves once a second."""

import threading
import time
from dataclasses import dataclass

from protocol.messages import StatsMessage

FORGOTTEN_AFTER_S = 3600.0


@dataclass(frozen=True)
class Report:
    """The newest report of a process, when it came (monotonic seconds) and how long it was on its way."""

    message: StatsMessage
    received_s: float
    delay_ms: float

    @property
    def age_s(self) -> float:
        """Seconds since it came."""
        return time.monotonic() - self.received_s


class ProcessWatch:
    """Keeps the newest report of every process (any thread)."""

    def __init__(self) -> None:
        self._reports: dict[str, Report] = {}
        self._lock = threading.Lock()

    def note(self, message: StatsMessage) -> Report:
        """Keep a report that has just come."""
        sent_ns = message.capture_ns + message.clock_offset_ns
        report = Report(message, time.monotonic(), (time.time_ns() - sent_ns) / 1e6)
        with self._lock:
            self._reports[message.node] = report
        return report

    def reports(self) -> list[Report]:
        """Newest report of each process, by name."""
        with self._lock:
            self._reports = {k: v for k, v in self._reports.items() if v.age_s < FORGOTTEN_AFTER_S}
            return [self._reports[name] for name in sorted(self._reports)]

    def detail(self, name: str) -> str:
        """What a process last said for people; empty where it said nothing."""
        report = self._reports.get(name)
        return "" if report is None else report.message.detail
