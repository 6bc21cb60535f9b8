"""A `deltalight` command as a child process that ends with the service, however that ends."""

import os
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable

from deltalight.protocol.errors import DeltalightError
from deltalight.services.parent_death_signal import SUPERVISOR_VARIABLE

KEPT_LINES = 20
START_TIMEOUT_S = 10.0


class ChildProcess:
    """Runs `deltalight ARGUMENTS`, started and watched by its own thread.

    The kernel sends the parent-death signal when the *thread* that started the child ends, so that thread lives as
    long as the child. It calls `on_line` with each line of output and `on_end` with the exit code.

    Raises:
        DeltalightError: the process cannot be started.
    """

    def __init__(
        self,
        *arguments: str,
        on_end: "Callable[[ChildProcess, int], None]",
        on_line: "Callable[[ChildProcess, str], None]" = lambda _child, _line: None,
    ) -> None:
        self._command = [
            sys.executable,
            "-P",
            "-m",
            "deltalight.services.cli",
            "--log-level",
            "warning",
            *arguments,
        ]
        self._on_line, self._on_end = on_line, on_end
        self._process: subprocess.Popen[str] | None = None
        self._errors: deque[str] = deque(maxlen=KEPT_LINES)
        self._is_started = threading.Event()
        self._fault = ""
        self._thread = threading.Thread(target=self._run, name=f"child-{arguments[0]}", daemon=True)
        self._thread.start()
        self._is_started.wait(START_TIMEOUT_S)
        if self._process is None:
            raise DeltalightError(f"{arguments[0]} cannot be started ({self._fault}); stop other programs.")

    @property
    def is_running(self) -> bool:
        """Whether it has not ended."""
        return self._process is not None and self._process.poll() is None

    @property
    def last_sentence(self) -> str:
        """The last line of its standard error without the command's name; empty if there is none."""
        line = next((line for line in reversed(self._errors) if line.strip()), "")
        return line.removeprefix("deltalight: ")

    def interrupt(self) -> None:
        """Interrupts it, as Ctrl-C does."""
        if self._process is not None and self.is_running:
            self._process.send_signal(signal.SIGINT)

    def end(self, timeout_s: float) -> None:
        """Terminates it and waits for its end and for `on_end`; kills it if that takes longer."""
        if self._process is None:
            return
        self._process.terminate()
        if not self.wait(timeout_s):
            self._process.kill()
            self.wait(timeout_s)

    def wait(self, timeout_s: float) -> bool:
        """Waits for its end and for `on_end`; returns whether it ended in time."""
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            process = self._process = self._started()
        except OSError as fault:
            self._fault = str(fault.strerror)
            return
        finally:
            self._is_started.set()
        reader = threading.Thread(target=self._read_errors, args=(process,), daemon=True)
        reader.start()
        assert process.stdout is not None
        with process.stdout as lines:
            for line in lines:
                self._on_line(self, line)
        reader.join()
        self._on_end(self, process.wait())

    def _started(self) -> "subprocess.Popen[str]":
        return subprocess.Popen(
            self._command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,  # Ctrl-C reaches the service only, which ends its children
            env={**os.environ, SUPERVISOR_VARIABLE: str(os.getpid())},
        )

    def _read_errors(self, process: "subprocess.Popen[str]") -> None:
        assert process.stderr is not None
        with process.stderr as lines:
            for line in lines:
                self._errors.append(line.rstrip())
