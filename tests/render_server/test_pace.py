"""The pace of work that leaves the cores to another process: it rests, and ends when it is called."""

import os
import time
from types import SimpleNamespace
from typing import Any

import pytest

from deltalight.render_server.server import pace
from deltalight.render_server.server.pace import (
    LONGEST_REST,
    POLL_S,
    REST,
    CalledError,
    Pace,
    idle_time_s,
)


class Calls:
    """Stands for the wait to be called; `waited_s` are the times that it was waited for."""

    def __init__(self) -> None:
        self.is_called = False
        self.waited_s: list[float] = []

    def __call__(self, timeout_s: float) -> bool:
        if timeout_s > 0:
            self.waited_s.append(timeout_s)
        return self.is_called


def gpu(*, is_software: bool) -> Any:  # noqa: ANN401 (a stand-in for a context)
    return SimpleNamespace(
        is_software=is_software, watchers=[], compile_watchers=[], ctx=SimpleNamespace(finish=lambda: None)
    )


def run_kernel(device: Any) -> None:  # noqa: ANN401
    for watch in device.watchers:
        watch(None)


def test_it_rests_in_proportion_to_what_it_worked() -> None:
    device, calls = gpu(is_software=False), Calls()
    with Pace(device, calls).kept():
        began_s = time.monotonic()
        time.sleep(0.02)
        run_kernel(device)
        worked_s = time.monotonic() - began_s
    assert len(calls.waited_s) == 1
    assert REST * 0.02 <= calls.waited_s[0] <= REST * (worked_s + 0.01)
    assert device.watchers == device.compile_watchers == []


def test_software_rests_by_processor_time() -> None:
    device, calls = gpu(is_software=True), Calls()
    with Pace(device, calls).kept():
        time.sleep(0.2)  # it waits for the cores, and uses none
        run_kernel(device)
    assert calls.waited_s == []


def work_s(seconds: float) -> float:
    began_s = time.process_time()
    while time.process_time() < began_s + seconds:
        pass
    return time.process_time() - began_s


@pytest.mark.skipif(idle_time_s() is None, reason="the host does not tell how long its cores are idle")
@pytest.mark.parametrize(("idle_share", "rest"), [(1.0, REST), (0.5, 2 * REST), (0.0, LONGEST_REST)])
def test_software_rests_until_the_cores_were_idle_for_as_long(
    idle_share: float, rest: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    device, calls, now_s = gpu(is_software=True), Calls(), [0.0]

    def wait(timeout_s: float) -> bool:
        now_s[0] += timeout_s
        return calls(timeout_s)

    monkeypatch.setattr(
        pace, "time", SimpleNamespace(monotonic=lambda: now_s[0], process_time=time.process_time)
    )
    monkeypatch.setattr(pace, "idle_time_s", lambda: idle_share * now_s[0])
    with Pace(device, wait).kept():
        worked_s = work_s(0.1)
        run_kernel(device)
    assert sum(calls.waited_s) == pytest.approx(rest * worked_s, rel=0.05, abs=1.5 * POLL_S)


def test_a_call_ends_a_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    device, calls = gpu(is_software=True), Calls()
    monkeypatch.setattr(pace, "idle_time_s", lambda: 0.0)

    def wait(timeout_s: float) -> bool:
        calls.is_called = timeout_s > 0 or calls.is_called
        return calls(timeout_s)

    with Pace(device, wait).kept():
        work_s(0.1)
        with pytest.raises(CalledError):
            run_kernel(device)
    assert calls.waited_s == [POLL_S]


def test_the_cores_idle_time_grows_no_faster_than_there_are_cores() -> None:
    before_s, began_s = idle_time_s(), time.monotonic()
    if before_s is None:
        pytest.skip("the host does not tell how long its cores are idle")
    time.sleep(0.2)
    after_s = idle_time_s()
    assert after_s is not None
    assert 0 <= after_s - before_s <= (os.cpu_count() or 1) * (time.monotonic() - began_s + 0.05)


def test_a_call_ends_what_may_end_at_the_next_kernel_and_lets_the_rest_go_on_without_rests() -> None:
    device, calls = gpu(is_software=False), Calls()
    kept = Pace(device, calls)
    calls.is_called = True
    with kept.kept():
        with pytest.raises(CalledError):
            run_kernel(device)
        kept.may_end = False
        run_kernel(device)
    assert calls.waited_s == []
