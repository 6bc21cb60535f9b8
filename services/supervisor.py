"""Keeps the processes of one host alive: restarts what dies or hangs, gives up after too many, ends all together."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from types import TracebackType
from typing import Self

from deltalight.protocol.errors import DeltalightError
from deltalight.services.child import Child, ChildSpec, end_all, take_spare
from deltalight.services.process import Process

POLL_INTERVAL_S = 0.1
RESTART_DELAY_S = 0.2
STEADY_AFTER_S = 5.0  # whoever ran that long is started again at once
MAXIMUM_RESTARTS = 5
RESTART_WINDOW_S = 60.0
WRONG_INPUT_EXIT_CODE = 2


class Supervisor:
    """Starts children, restarts those that die and ends all of them; a context manager.

    `spares` (`child.fork_spares`) become the first processes of the children of these names.

    Raises from `poll`:
        DeltalightError: a child refused its input (exit code 2; its own sentence is quoted), or died more
            than `maximum_restarts` times within a minute.
    """

    def __init__(
        self,
        specs: Sequence[ChildSpec],
        *,
        forward: Callable[[str], None] | None = None,
        maximum_restarts: int = MAXIMUM_RESTARTS,
        spares: Mapping[str, Process] | None = None,
    ) -> None:
        write = forward or (lambda line: print(line, file=sys.stderr, flush=True))
        self._children = [Child(spec, write) for spec in specs]
        self._maximum_restarts = maximum_restarts
        self._spares = spares or {}

    def __enter__(self) -> Self:
        try:
            for child in self._children:
                child.start(take_spare(self._spares.get(child.spec.name), child.spec))
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def process_ids(self) -> dict[str, int]:
        """Returns the process id of every started child, by name."""
        return {c.spec.name: c.process.pid for c in self._children if c.process is not None}

    def spare_ids(self) -> dict[str, int]:
        """Returns the process id of every spare that waits, by name."""
        return {c.spec.name: c.spare.pid for c in self._children if c.spare is not None}

    def restarts(self) -> dict[str, int]:
        """Returns how often each child was restarted, by name."""
        return {child.spec.name: max(child.started - 1, 0) for child in self._children}

    def poll(self) -> None:
        """Checks every child once; kills one that hangs and restarts one that died, but not one that ended well.

        Spares would take the processor from whoever still starts, so they come afterwards.
        """
        are_starting = any(child.is_starting() for child in self._children)
        for child in self._children:
            if not are_starting:
                child.start_spare_if_due()
            child.end_if_hanging()
            code = None if child.process is None else child.process.poll()
            if code is not None:
                child.end_watching()
            if code == 0:
                child.forward(f"{child.spec.name}: ended by itself.")
                child.process = None
            elif code is not None:
                self._restart(child, code)

    def run(self, until: Callable[[], bool] = lambda: False) -> None:
        """Polls until `until` returns true (or an exception ends the process)."""
        while not until():
            self.poll()
            time.sleep(POLL_INTERVAL_S)

    def stop(self) -> None:
        """Ends all children: SIGTERM to all, SIGKILL to those still alive after `STOP_TIMEOUT_S`."""
        processes = [each for child in self._children for each in (child.process, child.spare)]
        end_all([process for process in processes if process is not None])
        for child in self._children:
            child.end_watching()
            child.end_reading()

    def _restart(self, child: Child, exit_code: int) -> None:
        if exit_code == WRONG_INPUT_EXIT_CODE:
            raise DeltalightError(child.last_sentence())
        now_s = time.monotonic()
        child.deaths_s.append(now_s)
        while child.deaths_s[0] < now_s - RESTART_WINDOW_S:
            child.deaths_s.popleft()
        if len(child.deaths_s) > self._maximum_restarts:
            raise DeltalightError(
                f"The {child.spec.name} died {len(child.deaths_s)} times within a minute (exit code"
                f" {exit_code}) and is not started again; its last line was: {child.last_sentence()}"
            )
        child.forward(f"{child.spec.name}: died with exit code {exit_code}; restarting it.")
        if now_s - child.started_s < STEADY_AFTER_S:
            time.sleep(RESTART_DELAY_S)
        child.start()
