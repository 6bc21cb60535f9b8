"""Finds a render server that hangs although its process lives, by three signs of life.

* It reports each second, but not during a frame or a command: in software either may take minutes.
* It answers what the time is, from a thread of its own, but not while another command waits for the renderer, nor
  while the rendering thread is stuck in the driver, which keeps the interpreter's lock.
* It uses the processor, but not where it was stopped or waits for a GPU that hangs.
"""

import os
import threading
import time
import uuid
from collections import deque
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from deltalight.protocol.clock import CLOCK_OP
from deltalight.protocol.envelope import decode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys
from deltalight.protocol.messages import ControlRequest, StatsMessage
from deltalight.protocol.receiver import Receiver
from deltalight.protocol.request import RequestClient
from deltalight.protocol.subscriber import ReceivedMultipart

RECEIVE_TIMEOUT_S = 0.5
ANSWER_TIMEOUT_S = 1.0
LATE_AFTER_S = 3.0  # reports come each second; whoever is late is asked
REMEMBERED_GAPS = 10
WORKING_LOAD = 0.02  # of a core; waiting threads take less
DEAF_ON_GPU_S = 60.0  # the driver links the largest shader within some seconds
LONGEST_FRAME_ON_GPU_S = 300.0


@dataclass(frozen=True)
class WatchdogTimeouts:
    """How long signs of life may stay away, in seconds.

    Without any sign: `times` the longest time between the last reports, at least `floor_s`; `start_s` before the
    first report. Working, but neither reporting nor answering: `deaf_s`, longer than a server's longest call of the
    driver. Answering, but not reporting: `longest_frame_s`.
    """

    times: float = 10.0
    floor_s: float = 20.0
    start_s: float = 120.0
    deaf_s: float = 300.0
    longest_frame_s: float = 1800.0

    def on_gpu(self) -> "WatchdogTimeouts":
        """Returns that for a GPU, which needs no minutes for a kernel or a frame; its driver spins where it hangs."""
        return replace(self, deaf_s=DEAF_ON_GPU_S, longest_frame_s=LONGEST_FRAME_ON_GPU_S)


@dataclass
class Heartbeat:
    """When a process last gave which sign of life; all times are seconds of one clock."""

    timeouts: WatchdogTimeouts
    started_s: float
    reported_s: float | None = None
    answered_s: float = field(init=False)
    worked_s: float = field(init=False)
    _gaps_s: deque[float] = field(init=False, default_factory=lambda: deque(maxlen=REMEMBERED_GAPS))

    def __post_init__(self) -> None:
        self.answered_s = self.worked_s = self.started_s

    def note_report(self, now_s: float) -> None:
        """Notes that a report came."""
        if self.reported_s is not None:
            self._gaps_s.append(now_s - self.reported_s)
        self.reported_s = now_s

    def unreported_s(self, now_s: float) -> float:
        """Returns the seconds since the last report, or since the start."""
        return now_s - (self.started_s if self.reported_s is None else self.reported_s)

    def fault(self, now_s: float) -> str | None:
        """Returns what shows that the process hangs, None while nothing does."""
        unreported_s = self.unreported_s(now_s)
        unanswered_s = min(unreported_s, now_s - self.answered_s)
        silent_s = min(unanswered_s, now_s - self.worked_s)
        if silent_s > self._allowed_s():
            return f"gave no sign of life for {silent_s:.0f} s"
        if unanswered_s > max(self.timeouts.deaf_s, self._allowed_s()):
            return f"neither reported nor answered for {unanswered_s:.0f} s"
        if unreported_s > max(self.timeouts.longest_frame_s, self._allowed_s()):
            return f"finished nothing for {unreported_s:.0f} s"
        return None

    def _allowed_s(self) -> float:
        if self.reported_s is None:
            return self.timeouts.start_s
        return max(self.timeouts.floor_s, self.timeouts.times * max(self._gaps_s, default=0.0))


class Watchdog:
    """Listens to a render server, asks it and looks at its process, in a thread of its own until `close`.

    Raises:
        DeltalightError: an endpoint is malformed, or requires keys that are missing.
    """

    def __init__(
        self,
        process_id: int,
        reports: str,
        control: str,
        keys: Keys | None = None,
        timeouts: WatchdogTimeouts | None = None,
    ) -> None:
        self._heartbeat = Heartbeat(timeouts or WatchdogTimeouts(), time.monotonic())
        self._use = ProcessorUse(process_id)
        self._client = RequestClient(control, keys=keys)
        self._receiver = Receiver([reports], ["stats"], keys=keys)
        self._closing = threading.Event()
        self._knows_device = False
        self.newest: StatsMessage | None = None  # report
        self._thread = threading.Thread(target=self._run, name="watchdog", daemon=True)
        self._thread.start()

    def fault(self) -> str | None:
        """Returns what shows that the process hangs, None while nothing does (any thread)."""
        return self._heartbeat.fault(time.monotonic())

    def is_starting(self) -> bool:
        """Whether it has reported neither pictures nor a fault yet (any thread)."""
        return self.newest is None or self.newest.state in ("starting", "waiting")

    def close(self) -> None:
        """Stops listening; does not wait for an answer that is still expected."""
        self._closing.set()
        self._receiver.close()

    def _run(self) -> None:
        with closing(self._client):
            self._watch(self._heartbeat)

    def _watch(self, heartbeat: Heartbeat) -> None:
        while not self._closing.is_set():
            if reports := self._receiver.latest(RECEIVE_TIMEOUT_S):
                heartbeat.note_report(time.monotonic())
                for multipart in reports.values():
                    self._keep(multipart)
                if not self._knows_device:
                    self._learn_device()
            elif heartbeat.unreported_s(time.monotonic()) > LATE_AFTER_S:
                self._examine()

    def _keep(self, multipart: ReceivedMultipart) -> None:
        with suppress(DeltalightError):  # not understood, but a sign of life
            message = decode(multipart)[0]
            self.newest = message if isinstance(message, StatsMessage) else self.newest

    def _examine(self) -> None:
        if self._use.grew():
            self._heartbeat.worked_s = time.monotonic()
        if self._answer(CLOCK_OP) is not None:
            self._heartbeat.answered_s = time.monotonic()

    def _learn_device(self) -> None:
        answer = self._answer("stats")
        self._knows_device = answer is not None
        if answer is not None and answer.get("is_software") is False:
            self._heartbeat.timeouts = self._heartbeat.timeouts.on_gpu()

    def _answer(self, op: str) -> dict[str, Any] | None:
        request = ControlRequest(node="supervisor", id=uuid.uuid4().hex, op=op)
        try:
            reply = self._client.request(request, ANSWER_TIMEOUT_S)
        except DeltalightError:
            return None
        return reply.payload if reply.error is None else None


class ProcessorUse:
    """Tells whether a process works, by the processor time that it takes."""

    def __init__(self, process_id: int) -> None:
        self._process_id = process_id
        self._used_s, self._looked_s = 0.0, time.monotonic()

    def grew(self) -> bool:
        """Whether it worked since the last look, or since the start."""
        used_s, now_s = processor_time_s(self._process_id), time.monotonic()
        worked = used_s - self._used_s > WORKING_LOAD * (now_s - self._looked_s)
        self._used_s, self._looked_s = used_s, now_s
        return worked


def processor_time_s(process_id: int) -> float:
    """Returns the processor time that a process has used, by /proc (Linux); 0 if that is unknown."""
    try:
        fields = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")  # utime and stime, proc(5)
