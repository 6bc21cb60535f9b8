"""What a soaked station uses and loses over time: one sample a second."""

import os
import threading
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import httpx

from deltalight.benchmarks.soak.station import SERVER, Station
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.request import RequestClient
from deltalight.services import ports

PERIOD_S = 1.0
OBJECTS_EVERY = 3  # samples: counting takes the renderer some 30 ms
ANSWER_TIMEOUT_S = 2.0
DROPS = "deltalight_process_drops_total"
BAD_MESSAGES = "bad_messages"


@dataclass(frozen=True)
class ProcessSample:
    """Memory and open handles of a process."""

    process_id: int
    rss_bytes: int
    handles: int


@dataclass(frozen=True)
class Sample:
    """A moment of the station; `at_s` is of the monotonic clock, `drops` a sum since the processes' starts.

    What was not asked for or not answered is None; processes that were dead are left out.
    """

    at_s: float
    processes: Mapping[str, ProcessSample]
    drops: int | None
    bad_messages: int | None
    gl_objects: int | None


def read_process(process_id: int) -> ProcessSample:
    """Returns what /proc says (Linux).

    Raises:
        OSError: there is no such process, or no /proc.
    """
    folder = Path(f"/proc/{process_id}")
    pages = int((folder / "statm").read_text().split()[1])
    handles = sum(1 for _ in (folder / "fd").iterdir())
    return ProcessSample(process_id, pages * os.sysconf("SC_PAGE_SIZE"), handles)


def processor_time_s(process_id: int) -> float:
    """Returns the processor time that a process used since its start, all threads together (/proc).

    Raises:
        OSError: there is no such process, or no /proc.
    """
    numbers = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()
    return (int(numbers[11]) + int(numbers[12])) / os.sysconf("SC_CLK_TCK")


def require_proc(command: str) -> None:
    """Checks that a command can examine processes.

    Raises:
        DeltalightError: this is no Linux.
    """
    try:
        read_process(os.getpid())
    except OSError as fault:
        raise DeltalightError(f"`{command}` examines processes by /proc; run it on Linux.") from fault


@dataclass
class Sampler:
    """Takes samples in a thread of its own for the duration of the block."""

    station: Station
    samples: list[Sample] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sampler", daemon=True)

    def __enter__(self) -> "Sampler":
        self._thread.start()
        return self

    def __exit__(self, *_fault: object) -> None:
        self._ending.set()
        self._thread.join()

    def _run(self) -> None:
        number = 0
        with httpx.Client(base_url=self.station.client.base_url, timeout=ANSWER_TIMEOUT_S) as client:
            while not self._ending.wait(PERIOD_S):
                self.samples.append(self._take(client, with_objects=number % OBJECTS_EVERY == 0))
                number += 1

    def _take(self, client: httpx.Client, *, with_objects: bool) -> Sample:
        drops = self._drops(client)
        return Sample(
            time.monotonic(),
            self._processes(),
            None if drops is None else sum(drops.values()),
            None if drops is None else drops.get(BAD_MESSAGES, 0),
            self._objects() if with_objects else None,
        )

    def _processes(self) -> dict[str, ProcessSample]:
        found = {}
        for name in self.station.names:
            with suppress(OSError, KeyError):
                found[name] = read_process(self.station.process_id(name))
        return found

    def _drops(self, client: httpx.Client) -> dict[str, int] | None:
        try:
            lines = client.get("/metrics").raise_for_status().text.splitlines()
        except httpx.HTTPError:
            return None
        return parse_drops(lines)

    def _objects(self) -> int | None:
        request = ControlRequest(node="soak", id=uuid.uuid4().hex, op="gl_objects")
        client = RequestClient(ports.endpoint(self.station.places.control))
        try:
            reply = client.request(request, ANSWER_TIMEOUT_S)
        except DeltalightError:
            return None
        finally:
            client.close()
        counts = [count for count in reply.payload.values() if isinstance(count, int)]
        return sum(counts) if reply.error is None and counts else None


def parse_drops(lines: Sequence[str]) -> dict[str, int]:
    """Returns what all processes lost, by cause, of the text of `/metrics`."""
    found: dict[str, int] = {}
    for line in lines:
        if line.startswith(DROPS):
            labels, _, value = line.rpartition(" ")
            cause = labels.partition('cause="')[2].partition('"')[0]
            found[cause] = found.get(cause, 0) + int(float(value))
    return found


def of_process(samples: Sequence[Sample], name: str) -> list[tuple[float, ProcessSample]]:
    """Returns the samples of one process with their times."""
    return [(each.at_s, each.processes[name]) for each in samples if name in each.processes]


def steady_spans(
    samples: Sequence[Sample], is_calm: Callable[[float], bool], settle_s: float
) -> list[tuple[str, list[Sample]]]:
    """Returns the calm samples of each process by its name: one list for each id, without its first `settle_s`."""
    spans: dict[tuple[str, int], list[Sample]] = {}
    began: dict[tuple[str, int], float] = {}
    for sample in samples:
        for name, process in sample.processes.items():
            key = name, process.process_id
            first_s = began.setdefault(key, sample.at_s)
            if is_calm(sample.at_s) and sample.at_s >= first_s + settle_s:
                spans.setdefault(key, []).append(sample)
    return [(name, span) for (name, _), span in spans.items()]


def objects_of_server(samples: Sequence[Sample], settle_s: float) -> list[list[int]]:
    """Returns the numbers of GL objects of each render server after its first `settle_s`, if two or more."""
    spans = steady_spans(samples, lambda _at_s: True, settle_s)
    servers = [span for name, span in spans if name == SERVER]
    counts = [[each.gl_objects for each in span if each.gl_objects is not None] for span in servers]
    return [each for each in counts if len(each) > 1]
