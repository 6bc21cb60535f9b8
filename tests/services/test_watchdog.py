"""When a render server hangs, by its signs of life; one that is stopped is killed and started again."""

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from deltalight.protocol.envelope import encode
from deltalight.protocol.messages import StatsMessage
from deltalight.protocol.publisher import Publisher
from deltalight.protocol.request import ReplyServer
from deltalight.services import ports
from deltalight.services.child import ChildSpec
from deltalight.services.host import HostPlan
from deltalight.services.supervisor import Supervisor
from deltalight.services.watchdog import Heartbeat, Watchdog, WatchdogTimeouts, processor_time_s

TIMEOUTS = WatchdogTimeouts(times=10, floor_s=20, start_s=120, deaf_s=300, longest_frame_s=1800)
REPORTS = """
import sys, time
from deltalight.protocol.envelope import encode
from deltalight.protocol.messages import StatsMessage
from deltalight.protocol.publisher import Publisher
publisher = Publisher(sys.argv[1])
while True:
    publisher.send(encode(StatsMessage(node="server", capture_ns=time.time_ns(), state="running", frame_id=0)))
    time.sleep(0.05)
"""


def heartbeat(*reports_s: float) -> Heartbeat:
    made = Heartbeat(TIMEOUTS, 0.0)
    for each in reports_s:
        made.note_report(each)
    return made


def test_a_new_process_has_the_longest_time() -> None:
    new = heartbeat()
    assert new.fault(119) is None
    assert new.fault(121) == "gave no sign of life for 121 s"
    new.worked_s = 100  # it imports, or compiles shaders
    assert new.fault(219) is None


def test_silence_is_allowed_for_some_times_the_last_gap() -> None:
    quick, slow = heartbeat(1, 2, 3), heartbeat(1, 5, 6)
    assert quick.fault(22.9) is None
    assert quick.fault(23.1) == "gave no sign of life for 20 s"
    assert slow.fault(45.9) is None
    assert slow.fault(46.1) == "gave no sign of life for 40 s"


def test_a_process_that_works_or_answers_has_longer() -> None:
    busy = heartbeat(1, 2)
    busy.worked_s = busy.answered_s = 250
    assert busy.fault(260) is None
    busy.worked_s = 552
    assert busy.fault(549) is None
    assert busy.fault(551) == "neither reported nor answered for 301 s"
    busy.answered_s = 1801
    assert busy.fault(1802) is None
    assert busy.fault(1803) == "finished nothing for 1801 s"


def test_a_gpu_needs_no_minutes_for_one_call_or_frame() -> None:
    spinning = heartbeat(1, 2)
    spinning.timeouts = TIMEOUTS.on_gpu()
    spinning.worked_s = 61
    assert spinning.fault(61.9) is None
    assert spinning.fault(63) == "neither reported nor answered for 61 s"
    spinning.answered_s = 302
    assert spinning.fault(301) is None
    assert spinning.fault(303) == "finished nothing for 301 s"


def test_slow_frames_are_waited_for_on_a_gpu_too() -> None:
    slow = heartbeat(1, 41)
    slow.timeouts = TIMEOUTS.on_gpu()
    slow.worked_s = 441
    assert slow.fault(440) is None
    assert slow.fault(442) == "neither reported nor answered for 401 s"


def test_processor_time_is_that_of_the_process() -> None:
    before_s = processor_time_s(os.getpid())
    while time.process_time() < before_s + 0.1:
        pass
    assert before_s < processor_time_s(os.getpid()) <= time.process_time() + 0.02
    assert processor_time_s(2**22 + 1) == 0.0  # beyond the highest id


@pytest.fixture(params=[True, False], ids=["software", "gpu"])
def answering(request: pytest.FixtureRequest) -> Iterator[tuple[ReplyServer, WatchdogTimeouts]]:
    """A server that says on what it renders, and the timeouts that it needs."""
    server = ReplyServer("tcp://127.0.0.1:*", lambda _request: {"is_software": request.param})
    yield server, TIMEOUTS if request.param else TIMEOUTS.on_gpu()
    server.close()


def test_answers_and_reports_are_heard(
    answering: tuple[ReplyServer, WatchdogTimeouts], monkeypatch: pytest.MonkeyPatch
) -> None:
    server, needed = answering
    monkeypatch.setattr("deltalight.services.watchdog.LATE_AFTER_S", 0.0)
    publisher = Publisher("tcp://127.0.0.1:*")
    watchdog = Watchdog(os.getpid(), publisher.endpoint, server.endpoint, timeouts=TIMEOUTS)
    heard, began_s = watchdog._heartbeat, time.monotonic()
    assert watchdog.is_starting()
    while heard.reported_s is None or heard.answered_s <= began_s:
        publisher.send(encode(StatsMessage(node="server", capture_ns=1, state="running", frame_id=0)))
        time.sleep(0.7)  # longer than the watchdog waits for a report before it asks
        assert time.monotonic() < began_s + 30
    watchdog.close()
    publisher.close()
    assert not watchdog.is_starting()
    assert watchdog.fault() is None
    assert heard.timeouts == needed


def test_a_stopped_process_is_killed_and_started_again() -> None:
    reports, control = map(ports.endpoint, ports.private_ports(2))
    hasty = WatchdogTimeouts(times=0, floor_s=2.0)

    def watch(process_id: int) -> Watchdog:
        return Watchdog(process_id, reports, control, timeouts=hasty)

    lines: list[str] = []
    spec = ChildSpec("render server", ("-c", REPORTS, reports), watch)
    with Supervisor([spec], forward=lines.append) as supervisor:
        first = psutil.Process(supervisor.process_ids()["render server"])
        deadline_s = time.monotonic() + 60
        before = supervisor._children[0].watch
        assert isinstance(before, Watchdog)
        supervisor.run(until=lambda: before._heartbeat.reported_s is not None)
        first.send_signal(signal.SIGSTOP)
        supervisor.run(
            until=lambda: supervisor.restarts()["render server"] == 1 or time.monotonic() > deadline_s
        )
        assert supervisor.restarts() == {"render server": 1}
        assert not first.is_running()
        again = supervisor._children[0].watch
        assert again is not None
        assert again is not before
        assert again.fault() is None
    assert "render server: gave no sign of life for 2 s; killing it." in lines


def test_every_plan_watches_its_render_server(tmp_path: Path) -> None:
    watched = {spec.name: spec.watch is not None for spec in HostPlan("synthetic", tmp_path / "s").specs()}
    assert watched == {"sensor node": False, "render server": True}
