"""Keeps the processes of one host alive: restarts what dies or hangs, gives up after too many, ends all together.

Each child is a command line of its own (`python -P -m deltalight.services.cli ...`): one process, one OpenGL
context. `-P` keeps Python from importing what lies in the folder where the command was called.
"""

import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Protocol, Self

from deltalight.protocol.errors import DeltalightError
from deltalight.services.parent_death_signal import SUPERVISOR_VARIABLE
from deltalight.services.warm_spare import GO, spare_environment

POLL_INTERVAL_S = 0.1
RESTART_DELAY_S = 0.2
SPARE_AFTER_S = 4.0  # of a process's life: most have started by then
STEADY_AFTER_S = 5.0  # whoever ran that long is started again at once
MAXIMUM_RESTARTS = 5
RESTART_WINDOW_S = 60.0
STOP_TIMEOUT_S = 1.5  # then SIGKILL; all are gone within 2 s
WRONG_INPUT_EXIT_CODE = 2
KEPT_LINES = 20


class Watch(Protocol):
    """Tells whether a process hangs (`watchdog.Watchdog`)."""

    def fault(self) -> str | None:
        """Return what shows that it hangs, None while nothing does."""

    def close(self) -> None:
        """Stop watching."""


@dataclass(frozen=True)
class ChildSpec:
    """One supervised process: a name for display and the arguments after the interpreter.

    `watch` is called with the id of each started process; what it returns tells whether that hangs. With `warm`, a
    spare process that has prepared these (`warm_spare`) waits to take the place of one that dies.
    """

    name: str
    arguments: tuple[str, ...]
    watch: Callable[[int], Watch] | None = None
    warm: tuple[str, ...] = ()

    @classmethod
    def deltalight(cls, name: str, *arguments: str) -> "ChildSpec":
        """Return a child that runs a command of this command line."""
        return cls(name, ("-P", "-m", "deltalight.services.cli", *arguments))


@dataclass
class _Child:
    spec: ChildSpec
    forward: Callable[[str], None]
    process: subprocess.Popen[str] | None = None
    spare: subprocess.Popen[str] | None = None
    watch: Watch | None = None
    started: int = 0
    started_s: float = 0.0
    deaths_s: deque[float] = field(default_factory=deque)
    last_lines: deque[str] = field(default_factory=lambda: deque(maxlen=KEPT_LINES))
    reader: threading.Thread | None = None

    def start(self) -> None:
        self.last_lines.clear()
        self.process = self._take_spare() or self._open(subprocess.DEVNULL)
        self.started += 1
        self.started_s = time.monotonic()
        if self.spec.watch is not None:
            self.watch = self.spec.watch(self.process.pid)
        self.reader = threading.Thread(target=self._read, args=(self.process,), daemon=True)
        self.reader.start()

    def _open(self, stdin: int, more: Mapping[str, str] | None = None) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, *self.spec.arguments],
            stdin=stdin,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,  # Ctrl-C reaches the supervisor only, which ends them in order
            env={**os.environ, SUPERVISOR_VARIABLE: str(os.getpid()), **(more or {})},
        )

    def start_spare_if_due(self) -> None:
        """Start a spare once the process itself has had the time to start; none again for one that died."""
        due = self.spec.warm and self.process is not None and self.spare is None
        if due and time.monotonic() - self.started_s >= SPARE_AFTER_S:
            self.spare = self._open(subprocess.PIPE, spare_environment(self.spec.warm))

    def _take_spare(self) -> subprocess.Popen[str] | None:
        """Return the spare, which starts now, None if there is none."""
        spare, self.spare = self.spare, None
        if spare is None or spare.poll() is not None:
            return None
        assert spare.stdin is not None
        try:
            with spare.stdin as told:
                told.write(GO.decode())
        except OSError:  # it died meanwhile
            spare.kill()
            spare.wait()
            return None
        return spare

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stderr is not None
        with process.stderr as lines:
            for line in lines:
                self.last_lines.append(line.rstrip())
                self.forward(f"{self.spec.name}: {line.rstrip()}")

    def last_sentence(self) -> str:
        """Return the last line that the child wrote, without the command's name before it."""
        if self.reader is not None:
            self.reader.join(timeout=1.0)
        line = next((line for line in reversed(self.last_lines) if line.strip()), "it said nothing")
        return line.removeprefix("deltalight: ")

    def end_if_hanging(self) -> None:
        fault = None if self.watch is None else self.watch.fault()
        if fault is not None and self.process is not None:
            self.forward(f"{self.spec.name}: {fault}; it is killed.")
            self.process.kill()
            self.process.wait()

    def end_watching(self) -> None:
        if self.watch is not None:
            self.watch.close()
            self.watch = None

    def end_reading(self) -> None:
        if self.reader is not None:
            self.reader.join(timeout=0.2)


class Supervisor:
    """Starts children, restarts those that die and ends all of them; a context manager.

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
    ) -> None:
        write = forward or (lambda line: print(line, file=sys.stderr, flush=True))
        self._children = [_Child(spec, write) for spec in specs]
        self._maximum_restarts = maximum_restarts

    def __enter__(self) -> Self:
        try:
            for child in self._children:
                child.start()
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def process_ids(self) -> dict[str, int]:
        """Return the process id of every started child, by name."""
        return {c.spec.name: c.process.pid for c in self._children if c.process is not None}

    def spare_ids(self) -> dict[str, int]:
        """Return the process id of every spare that waits, by name."""
        return {c.spec.name: c.spare.pid for c in self._children if c.spare is not None}

    def restarts(self) -> dict[str, int]:
        """Return how often each child was restarted, by name."""
        return {child.spec.name: max(child.started - 1, 0) for child in self._children}

    def poll(self) -> None:
        """Check every child once; kill one that hangs and restart one that died, but not one that ended well."""
        for child in self._children:
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
        """Poll until `until` returns true (or an exception ends the process)."""
        while not until():
            self.poll()
            time.sleep(POLL_INTERVAL_S)

    def stop(self) -> None:
        """End all children: SIGTERM to all, SIGKILL to those still alive after `STOP_TIMEOUT_S`."""
        all_processes = [each for child in self._children for each in (child.process, child.spare)]
        processes = [process for process in all_processes if process is not None]
        try:
            for process in processes:
                process.terminate()
            deadline_s = time.monotonic() + STOP_TIMEOUT_S
            for process in processes:
                _wait(process, deadline_s - time.monotonic())
        finally:  # a second Ctrl-C must not leave orphans
            for process in processes:
                process.kill()
                process.wait()
        for child in self._children:
            child.end_watching()
            child.end_reading()

    def _restart(self, child: _Child, exit_code: int) -> None:
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
        child.forward(f"{child.spec.name}: died with exit code {exit_code}; it is started again.")
        if now_s - child.started_s < STEADY_AFTER_S:
            time.sleep(RESTART_DELAY_S)
        child.start()


def _wait(process: subprocess.Popen[str], timeout_s: float) -> None:
    try:
        process.wait(max(timeout_s, 0.0))
    except subprocess.TimeoutExpired:
        return
