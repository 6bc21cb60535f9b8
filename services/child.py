"""A child process of this host's: its command line, its start, its output, and whether it hangs.

Each is a command line of its own (`python -P -m deltalight.services.cli ...`): one process, one OpenGL
context. `-P` keeps Python from importing what lies in the folder where the command was called.
"""

import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

from deltalight.services.parent_death_signal import SUPERVISOR_VARIABLE
from deltalight.services.process import ForkedProcess, Process, fork
from deltalight.services.warm_spare import PREPARED, rehearse_spare, spare_environment, use_spare

NODE, SERVER, WEB = "sensor node", "render server", "web process"  # names of a host's processes
SPARE_AFTER_S = 4.0  # of a process's life: most have started by then
FIRST_PICTURE_S = 30.0  # how long spares wait for it at most: there may be no camera
STOP_TIMEOUT_S = 1.5  # then SIGKILL; all are gone within 2 s
KEPT_LINES = 20


class Watch(Protocol):
    """Tells whether a process hangs (`watchdog.Watchdog`)."""

    def fault(self) -> str | None:
        """Returns what shows that it hangs, None while nothing does."""

    def is_starting(self) -> bool:
        """Whether it has not done yet what it is for."""

    def close(self) -> None:
        """Stops watching."""


@dataclass(frozen=True)
class ChildSpec:
    """One supervised process: a name for display and the arguments after the interpreter.

    `watch` is called with the id of each started process; what it returns tells whether that hangs. With `warm`, a
    spare process that has prepared these (`warm_spare`) waits to take the place of one that dies; with `rehearsed`,
    it also gets ready for this command line.
    """

    name: str
    arguments: tuple[str, ...]
    watch: Callable[[int], Watch] | None = None
    warm: tuple[str, ...] = ()
    rehearsed: bool = False

    @classmethod
    def deltalight(cls, name: str, *arguments: str) -> "ChildSpec":
        """Returns a child that runs a command of this command line."""
        return cls(name, ("-P", "-m", "deltalight.services.cli", *arguments))

    @property
    def words(self) -> tuple[str, ...]:
        """What follows the name `deltalight` on the command line."""
        return self.arguments[len(ChildSpec.deltalight("").arguments) :]


@dataclass
class Child:
    """A process of a `spec`, which may be started again; `forward` gets its lines, with its name before them."""

    spec: ChildSpec
    forward: Callable[[str], None]
    process: Process | None = None
    spare: Process | None = None
    watch: Watch | None = None
    started: int = 0
    started_s: float = 0.0
    deaths_s: deque[float] = field(default_factory=deque)
    last_lines: deque[str] = field(default_factory=lambda: deque(maxlen=KEPT_LINES))
    reader: threading.Thread | None = None

    def start(self, spare: Process | None = None) -> None:
        """Starts it, by a process that waits for these arguments if there is one."""
        self.last_lines.clear()
        self.process = spare or self._take_spare() or open_process(self.spec.arguments, subprocess.DEVNULL)
        self.started += 1
        self.started_s = time.monotonic()
        if self.spec.watch is not None:
            self.watch = self.spec.watch(self.process.pid)
        self.reader = threading.Thread(target=self._read, args=(self.process,), daemon=True)
        self.reader.start()

    def is_starting(self) -> bool:
        """Whether it is young and not seen to do yet what it is for."""
        is_young = time.monotonic() - self.started_s < FIRST_PICTURE_S
        return is_young and self.watch is not None and self.watch.is_starting()

    def start_spare_if_due(self) -> None:
        """Starts a spare once the process itself has had the time to start; none again for one that died."""
        due = self.spec.warm and self.process is not None and self.spare is None
        if due and time.monotonic() - self.started_s >= SPARE_AFTER_S:
            self.spare = open_spare(self.spec.arguments, self.spec.warm)
            if self.spec.rehearsed:
                rehearse_spare(self.spare, self.spec.words)

    def _take_spare(self) -> Process | None:
        """Returns the spare, which starts now, None if there is none."""
        spare, self.spare = self.spare, None
        return spare if spare is not None and use_spare(spare) else None

    def _read(self, process: Process) -> None:
        assert process.stderr is not None
        with process.stderr as lines:
            for line in lines:
                self.last_lines.append(line.rstrip())
                self.forward(f"{self.spec.name}: {line.rstrip()}")

    def last_sentence(self) -> str:
        """Returns the last line that the child wrote, without the command's name before it."""
        if self.reader is not None:
            self.reader.join(timeout=1.0)
        line = next((line for line in reversed(self.last_lines) if line.strip()), "it said nothing")
        return line.removeprefix("deltalight: ")

    def end_if_hanging(self) -> None:
        """Kills it if it hangs, and says so."""
        fault = None if self.watch is None else self.watch.fault()
        if fault is not None and self.process is not None:
            self.forward(f"{self.spec.name}: {fault}; killing it.")
            self.process.kill()
            self.process.wait()

    def end_watching(self) -> None:
        """Stops looking whether it hangs."""
        if self.watch is not None:
            self.watch.close()
            self.watch = None

    def end_reading(self) -> None:
        """Waits shortly for its last lines."""
        if self.reader is not None:
            self.reader.join(timeout=0.2)


def open_process(
    arguments: Sequence[str], stdin: int, more: Mapping[str, str] | None = None
) -> subprocess.Popen[str]:
    """Starts Python with these arguments, and `more` in the environment; it ends with this process."""
    return subprocess.Popen(
        [sys.executable, *arguments],
        stdin=stdin,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,  # Ctrl-C reaches the supervisor only, which ends them in order
        env={**os.environ, SUPERVISOR_VARIABLE: str(os.getpid()), **(more or {})},
    )


def open_spare(arguments: Sequence[str], prepared: tuple[str, ...]) -> subprocess.Popen[str]:
    """Starts a process that prepares these (`warm_spare`) and waits."""
    return open_process(arguments, subprocess.PIPE, spare_environment(prepared))


def fork_spares(
    commands: Mapping[str, str], earlier: Mapping[str, Process] | None = None
) -> dict[str, Process]:
    """Forks a spare of each command, by the name of its process, and returns them with the `earlier` ones.

    They are for a `Supervisor` (`ending_spares`), and share what this process has imported. Only Linux forks safely,
    and only a process with one thread; elsewhere they are started.

    Raises:
        InForkedChild: in each of them.
    """
    spares = dict(earlier or {})
    for name, command in commands.items():
        if sys.platform.startswith("linux") and threading.active_count() == 1:
            forked = [each for each in spares.values() if isinstance(each, ForkedProcess)]
            spares[name] = fork((command,), spare_environment(PREPARED[command]), forked)
        else:
            spares[name] = open_spare(ChildSpec.deltalight(name, command).arguments, PREPARED[command])
    return spares


@contextmanager
def ending_spares(spares: Mapping[str, Process]) -> Iterator[Mapping[str, Process]]:
    """Ends those of the spares at the end that nobody took."""
    try:
        yield spares
    finally:
        end_all([spare for spare in spares.values() if spare.stdin is not None and not spare.stdin.closed])


def take_spare(spare: Process | None, spec: ChildSpec) -> Process | None:
    """Tells a spare to go on as a deltalight command; None where there is no spare, or it died."""
    return spare if spare is not None and use_spare(spare, spec.words) else None


def end_all(processes: Sequence[Process]) -> None:
    """Ends processes: SIGTERM to all, SIGKILL to those still alive after `STOP_TIMEOUT_S`."""
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


def _wait(process: Process, timeout_s: float) -> None:
    try:
        process.wait(max(timeout_s, 0.0))
    except subprocess.TimeoutExpired:
        return
