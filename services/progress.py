"""Whether processes are at work: on their start, or on a frame."""

import math
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Self

from deltalight.protocol.envelope import decode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import StatsMessage
from deltalight.protocol.receiver import Receiver
from deltalight.protocol.subscriber import ReceivedMultipart
from deltalight.services.watchdog import LATE_AFTER_S, ProcessorUse

LOOK_INTERVAL_S = 1.0  # /proc counts in hundredths of a second


class Progress:
    """Notes when one of some processes was last at work; a context manager.

    Who waits reports each second, and who starts or renders does not, or says that it starts: it uses the processor
    meanwhile. It may not answer then, where the driver keeps the interpreter's lock. `endpoints` are those of the
    reports, by process.
    """

    def __init__(self, endpoints: Mapping[str, str]) -> None:
        self.at_work_s = self._looked_s = time.monotonic()
        self._receivers = {name: Receiver([each], ["stats"]) for name, each in endpoints.items()}
        self._reported_s = dict.fromkeys(endpoints, -math.inf)
        self._uses: dict[int, ProcessorUse] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        for receiver in self._receivers.values():
            receiver.close()

    def look(self, process_ids: Mapping[str, int]) -> None:
        """Looks at these processes, by name, if the last look is a while ago."""
        now_s = time.monotonic()
        if now_s - self._looked_s < LOOK_INTERVAL_S:
            return
        self._looked_s = now_s
        works = [self._is_at_work(name, process_ids[name]) for name in self._receivers if name in process_ids]
        if any(works):
            self.at_work_s = now_s

    def _is_at_work(self, name: str, process_id: int) -> bool:
        now_s = time.monotonic()
        reports = (self._receivers[name].latest(0.0) or {}).values()
        if any(map(_is_of_who_waits, reports)):
            self._reported_s[name] = now_s
        works = self._uses.setdefault(process_id, ProcessorUse(process_id)).grew()
        return works and now_s - self._reported_s[name] > LATE_AFTER_S


def _is_of_who_waits(multipart: ReceivedMultipart) -> bool:
    """Whether a report is not that of a process which says that it starts; a malformed one is of nobody."""
    try:
        message, _ = decode(multipart)
    except DeltalightError:
        return False
    return isinstance(message, StatsMessage) and message.state != "starting"
