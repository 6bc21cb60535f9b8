"""The pace of work that leaves the cores and the GPU to another process until its result is needed."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from deltalight.render_server.gpu.context import GpuContext

REST = 2.0  # times as long as it works

IsCalled = Callable[[float], bool]
"""Waits so many seconds at most to be called; returns whether it is."""


class CalledError(BaseException):
    """What is being built is needed now, and is not ready."""


class Pace:
    """Rests between kernels and programs until it is called, and ends what is being built there if it `may_end`.

    A lower priority would not do: a process without privileges does not get its own back, and a GPU knows none.
    """

    def __init__(self, gpu: GpuContext, is_called: IsCalled) -> None:
        self.may_end = True
        self._gpu, self._is_called = gpu, is_called
        self._clock = time.process_time if gpu.is_software else time.monotonic
        self._since_s = self._clock()

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Keeps the pace in the block."""
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
            self._is_called(REST * (self._clock() - self._since_s))
            self._since_s = self._clock()
        if self.may_end and self._is_called(0.0):
            raise CalledError
