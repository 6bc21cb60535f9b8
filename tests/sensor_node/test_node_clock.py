"""The server's clock as a node follows it: a clock that is set is noticed, told, and compared again."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from deltalight.protocol.clock import clock_payload
from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.request import ReplyServer
from deltalight.sensor_node import capture
from deltalight.sensor_node.capture import ServerClock

SECOND = 1_000_000_000


class SettableClock:
    """The system's clock, and how far it was set."""

    def __init__(self) -> None:
        self.ahead_ns = 0

    def __call__(self) -> int:
        return time.time_ns() + self.ahead_ns


@contextmanager
def following(tmp_path: Path) -> Iterator[tuple[ServerClock, SettableClock, SettableClock]]:
    """A clock that follows a server's; and both hosts' own."""
    here, there = SettableClock(), SettableClock()

    def answer(_: ControlRequest) -> dict[str, object]:
        return clock_payload(there(), there)

    server = ReplyServer(f"ipc://{tmp_path}/control", answer)
    clock = ServerClock("desk", server.endpoint, now=here)
    try:
        wait_until(lambda: clock.at(here())[1] is not None)
        yield clock, here, there
    finally:
        clock.close()
        server.close()


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert condition()


def test_this_hosts_clock_that_is_set_voids_the_offset_at_once(tmp_path: Path) -> None:
    with following(tmp_path) as (clock, here, _):
        captured_ns = here()
        assert clock.remark == ""
        here.ahead_ns = 10 * SECOND
        # Never the old offset with the old bound, which would be wrong by 10 s.
        offset_ns, bound_ns = clock.at(captured_ns)
        assert bound_ns is None or abs(offset_ns + 10 * SECOND) <= bound_ns
        wait_until(lambda: clock.at(here())[1] is not None)
        offset_ns, bound_ns = clock.at(here())
        assert bound_ns is not None
        assert abs(offset_ns + 10 * SECOND) <= bound_ns < SECOND
        assert clock.remark.startswith("this host's clock was set by +10 s")


def test_the_servers_clock_that_is_set_is_noticed_at_the_next_comparison(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capture, "CLOCK_PERIOD_S", 0.05)
    with following(tmp_path) as (clock, here, there):
        there.ahead_ns = -10 * SECOND
        wait_until(lambda: clock.remark != "")
        assert clock.remark.startswith("the server's clock was set by -10 s")
        offset_ns, bound_ns = clock.at(here())
        assert bound_ns is not None
        assert abs(offset_ns + 10 * SECOND) <= bound_ns < SECOND


def test_without_a_server_a_clock_that_is_set_is_nobodys_concern() -> None:
    here = SettableClock()
    clock = ServerClock("desk", None, now=here)
    here.ahead_ns = 10 * SECOND
    assert clock.at(here()) == (0, None)
    assert clock.remark == ""
    clock.close()
