"""How long a headless demo waits: for as long as a process starts, or is at work on a picture."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from types import SimpleNamespace
from typing import Any

import pytest

from deltalight.protocol.envelope import encode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.publisher import Publisher
from deltalight.services import headless_demo, ports
from deltalight.services import progress as progress_module
from deltalight.services.child import SERVER
from deltalight.services.progress import Progress
from tests.services.live_samples import report

BUSY = "while True: pass"
IDLE = "import time; time.sleep(600)"
PATIENCE_S = 60
Start = Callable[[str], int]


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    """Starts a process that runs a line of Python; returns its id."""
    monkeypatch.setattr(progress_module, "LOOK_INTERVAL_S", 0.1)
    started: list[subprocess.Popen[bytes]] = []

    def begin(code: str) -> int:
        started.append(subprocess.Popen([sys.executable, "-S", "-c", code]))
        return started[-1].pid

    yield begin
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture
def publisher() -> Iterator[Publisher]:
    with closing(Publisher(ports.endpoint(ports.private_ports(1)[0]))) as made:
        yield made


def idle_looks(
    progress: Progress, process_id: int, count: int, says: Callable[[], None] = lambda: None
) -> bool:
    """Whether so many looks one after the other find the process idle, within the test's patience."""
    idle, deadline_s = 0, time.monotonic() + PATIENCE_S
    while idle < count and time.monotonic() < deadline_s:
        before_s = progress.at_work_s
        says()
        time.sleep(0.15)
        progress.look({SERVER: process_id})
        idle = idle + 1 if progress.at_work_s == before_s else 0
    return idle == count


def test_who_computes_and_says_nothing_is_at_work(start: Start, publisher: Publisher) -> None:
    """It answers nothing either: a driver that compiles keeps the interpreter's lock."""
    with Progress({SERVER: publisher.endpoint}) as progress:
        busy, before_s = start(BUSY), progress.at_work_s
        deadline_s = time.monotonic() + PATIENCE_S
        while progress.at_work_s == before_s:
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
            progress.look({SERVER: busy})


def test_who_sleeps_is_not(start: Start, publisher: Publisher) -> None:
    with Progress({SERVER: publisher.endpoint}) as progress:
        assert idle_looks(progress, start(IDLE), 5)


def test_who_reports_waits(start: Start, publisher: Publisher) -> None:
    with Progress({SERVER: publisher.endpoint}) as progress:
        assert idle_looks(progress, start(BUSY), 5, lambda: publisher.send(encode(report("server"))))


def test_who_reports_that_it_starts_is_at_work(start: Start, publisher: Publisher) -> None:
    with Progress({SERVER: publisher.endpoint}) as progress:
        busy, before_s = start(BUSY), progress.at_work_s
        deadline_s = time.monotonic() + PATIENCE_S
        while progress.at_work_s == before_s:
            assert time.monotonic() < deadline_s
            publisher.send(encode(report("server").model_copy(update={"state": "starting"})))
            time.sleep(0.05)
            progress.look({SERVER: busy})


class Pictures:
    """A collector that has one after so many looks."""

    def __init__(self, looks: int) -> None:
        self.count, self._left = 0, looks

    def take(self, _timeout_s: float, _limit: int) -> bool:
        time.sleep(0.02)
        self._left -= 1
        self.count = int(self._left <= 0)
        return self.count == 1


def collect(pictures: Pictures, *, at_work: bool) -> None:
    supervisor: Any = SimpleNamespace(poll=lambda: None, process_ids=dict)
    progress: Any = SimpleNamespace(at_work_s=time.monotonic())

    def look(_ids: object) -> None:
        if at_work:
            progress.at_work_s = time.monotonic()

    progress.look = look
    collector: Any = pictures
    headless_demo._collect(collector, supervisor, progress, 1)


def test_a_picture_may_take_as_long_as_somebody_is_at_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(headless_demo, "FIRST_FRAME_PATIENCE_S", 0.5)
    patient = Pictures(looks=60)  # more than a second
    collect(patient, at_work=True)
    assert patient.count == 1
    with pytest.raises(DeltalightError, match="Only 0 of 1 composites"):
        collect(Pictures(looks=10_000), at_work=False)


def test_who_is_at_work_for_too_long_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(headless_demo, "LONGEST_FRAME_S", 0.1)
    with pytest.raises(DeltalightError, match="Only 0 of 1 composites"):
        collect(Pictures(looks=10_000), at_work=True)
