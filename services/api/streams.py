"""Subscriptions to nodes and render servers, and their newest reports."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import structlog

from deltalight.protocol.envelope import decode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys
from deltalight.protocol.message_fields import as_counts
from deltalight.protocol.messages import Message, StatsMessage
from deltalight.protocol.receiver import Receiver
from deltalight.protocol.subscriber import ReceivedMultipart

RECEIVE_TIMEOUT_S = 0.2
LOG_INTERVAL_S = 1.0  # a faulty node sends hundreds of messages a second
DEGRADED_LOG_INTERVAL_S = 60.0  # of one process, whose state may come and go
FORGOTTEN_AFTER_S = 3600.0
RADIANCE = "radiance."  # prefix of the topics on which nodes publish measured light

Sink = Callable[[Message, Sequence[memoryview]], None]

log = structlog.get_logger()


@dataclass(frozen=True)
class Report:
    """The newest report of a process, its time of arrival (monotonic seconds) and its latency.

    `before` holds what processes of its name had lost that said that they end, by cause. `degraded` is how often a
    process of its name came into that state, `logged_s` when that was last logged, and `is_told` whether it was of
    the present time.
    """

    message: StatsMessage
    received_s: float
    delay_ms: float
    before: Mapping[str, int] = field(default_factory=dict)
    degraded: int = 0
    logged_s: float | None = None
    is_told: bool = False

    @property
    def is_degraded(self) -> bool:
        """Whether the process works, but not as it should."""
        return self.message.state == "degraded"

    @property
    def lost(self) -> dict[str, int]:
        """What it and those before it lost, by cause."""
        lost = Counter(self.message.drops)
        lost.update(self.before)
        return as_counts(lost)

    @property
    def age_s(self) -> float:
        """Seconds since it arrived."""
        return time.monotonic() - self.received_s


class ProcessWatch:
    """Keeps the newest report of every process (any thread)."""

    def __init__(self) -> None:
        self._reports: dict[str, Report] = {}
        self._lock = threading.Lock()

    def note(self, message: StatsMessage) -> Report:
        """Stores a report that has just arrived."""
        sent_ns = message.capture_ns + message.clock_offset_ns
        delay_ms = (time.time_ns() - sent_ns) / 1e6
        with self._lock:
            earlier = self._reports.get(message.node)
            report = Report(message, time.monotonic(), delay_ms, self._lost_before(message.node))
            report = self._reports[message.node] = _judged(report, earlier)
        return report

    def _lost_before(self, name: str) -> Mapping[str, int]:
        newest = self._reports.get(name)
        if newest is None:
            return {}
        return newest.lost if newest.message.state == "stopping" else newest.before

    def reports(self) -> list[Report]:
        """Returns the newest report of each process, ordered by name."""
        with self._lock:
            self._reports = {k: v for k, v in self._reports.items() if v.age_s < FORGOTTEN_AFTER_S}
            return [self._reports[name] for name in sorted(self._reports)]

    def detail(self, name: str) -> str:
        """Returns the detail of a process's newest report; empty if there is none."""
        report = self._reports.get(name)
        return "" if report is None else report.message.detail


def _judged(report: Report, earlier: Report | None) -> Report:
    """Counts and logs that a process has become degraded, or is no longer."""
    if earlier is not None:
        report = replace(report, degraded=earlier.degraded, logged_s=earlier.logged_s)
        if earlier.is_degraded and report.is_degraded:
            return replace(report, is_told=earlier.is_told)
        if earlier.is_told:
            log.info("a process is no longer degraded", process=report.message.node, times=report.degraded)
    return _newly_degraded(report) if report.is_degraded else report


def _newly_degraded(report: Report) -> Report:
    is_told = report.logged_s is None or report.received_s - report.logged_s >= DEGRADED_LOG_INTERVAL_S
    if is_told:
        log.warning("a process is degraded", process=report.message.node, detail=report.message.detail)
    logged_s = report.received_s if is_told else report.logged_s
    return replace(report, degraded=report.degraded + 1, logged_s=logged_s, is_told=is_told)


class Streams:
    """Hands the newest message of each topic to the sink of its stream, in its own thread."""

    def __init__(self, endpoints: Sequence[str], sinks: Mapping[str, Sink], keys: Keys | None = None) -> None:
        self._receiver = Receiver(endpoints, list(sinks), keys=keys)
        self._keys = keys
        self._sinks = sinks
        self._source: Receiver | None = None
        self._changing = threading.Lock()
        self._refused = 0
        self._logged_s = -LOG_INTERVAL_S
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="streams", daemon=True)

    def start(self) -> None:
        """Starts listening."""
        self._thread.start()

    def use_source(self, endpoints: Sequence[str] | None) -> None:
        """Subscribes also to the source that the render server reads from now on; None = its own nodes.

        With such a source, radiance comes from there only.
        """
        with self._changing:
            before = self._source
            self._source = Receiver(endpoints, list(self._sinks), keys=self._keys) if endpoints else None
        if before is not None:
            before.close()

    def follow(self, endpoints: Sequence[str]) -> None:
        """Listens to these endpoints in place of the earlier ones."""
        with self._changing:
            before, self._receiver = self._receiver, Receiver(endpoints, list(self._sinks), keys=self._keys)
        before.close()

    def close(self) -> None:
        """Stops listening."""
        self._stop.set()
        self.use_source(None)
        self._receiver.close()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            own = self._receiver.latest(RECEIVE_TIMEOUT_S) or {}
            source = self._source
            for topic, multipart in own.items():
                if source is None or not topic.startswith(RADIANCE):
                    self._pass_on(multipart)
            for multipart in (source.latest(0) or {}).values() if source is not None else ():
                self._pass_on(multipart)

    def _pass_on(self, multipart: ReceivedMultipart) -> None:
        try:
            message, parts = decode(multipart)
            self._sinks[message.stream](message, parts)
        except DeltalightError as fault:
            self._log(fault)

    def _log(self, fault: DeltalightError) -> None:
        self._refused += 1
        if time.monotonic() - self._logged_s >= LOG_INTERVAL_S:
            self._logged_s = time.monotonic()
            log.warning("message not understood", fault=str(fault), so_far=self._refused)
