"""The pace of work that leaves the cores to another process: it rests, and ends when it is called."""

import time
from types import SimpleNamespace
from typing import Any

import pytest

from deltalight.render_server.server.pace import REST, CalledError, Pace


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
    assert sum(calls.waited_s) < REST * 0.2


def test_a_call_ends_what_may_end_at_the_next_kernel_and_lets_the_rest_go_on_without_rests() -> None:
    device, calls = gpu(is_software=False), Calls()
    pace = Pace(device, calls)
    calls.is_called = True
    with pace.kept():
        with pytest.raises(CalledError):
            run_kernel(device)
        pace.may_end = False
        run_kernel(device)
    assert calls.waited_s == []
