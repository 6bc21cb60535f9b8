"""The pace of work that leaves the cores and the GPU to another process until its result is needed."""

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from deltalight.render_server.gpu.context import GpuContext

REST = 2.0  # times as long as it works
LONGEST_REST = 10.0  # likewise, where the cores are never idle
POLL_S = 0.02
CPU_TIMES = Path("/proc/stat")

IsCalled = Callable[[float], bool]
"""Waits for at most so many seconds; returns whether the spare was called to take over."""


class CalledError(BaseException):
    """The spare must take over before what it builds is ready."""


class Pace:
    """Throttles a spare by rests between kernels, until it is called; then ends what it builds if it `may_end`.

    In software the spare takes a third of the processor time that others leave. A lower priority would not do: a
    process without privileges cannot raise it again, and a GPU has no priorities.
    """

    def __init__(self, gpu: GpuContext, is_called: IsCalled) -> None:
        self.may_end = True
        self._gpu, self._is_called = gpu, is_called
        self._clock = time.process_time if gpu.is_software else time.monotonic
        self._since_s = self._clock()

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Context that is throttled."""
        watchers = self._gpu.watchers, self._gpu.compile_watchers
        for each in watchers:
            each.append(self._rest)
        try:
            yield
        finally:
            for each in watchers:
                each.remove(self._rest)

    def _rest(self, *_: object) -> None:
        if not self._is_called(0.0):
            self._gpu.ctx.finish()
            worked_s = self._clock() - self._since_s
            if REST * worked_s >= POLL_S:
                self._rest_from(worked_s)
                self._since_s = self._clock()
        if self.may_end and self._is_called(0.0):
            raise CalledError

    def _rest_from(self, worked_s: float) -> None:
        since_s = idle_time_s() if self._gpu.is_software else None
        if since_s is None:
            self._is_called(REST * worked_s)
            return
        ends_s = time.monotonic() + LONGEST_REST * worked_s
        while (idle_time_s() or 0.0) - since_s < REST * worked_s and time.monotonic() < ends_s:
            if self._is_called(POLL_S):
                return


def idle_time_s() -> float | None:
    """Returns how long the host's cores were idle since its start, in seconds of a core; None if it cannot tell."""
    try:
        _, _user, _nice, _system, idle, waiting, *_ = CPU_TIMES.read_text().split(maxsplit=6)
        return (int(idle) + int(waiting)) / os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError):  # no Linux
        return None
