"""A process as the one that started it sees it, and children that are forked: they need not import again what their
parent has imported.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from typing import IO, Protocol

from deltalight.services.parent_death_signal import SUPERVISOR_VARIABLE

POLL_INTERVAL_S = 0.01


class Process(Protocol):
    """What is used of a child: `subprocess.Popen[str]`, or a `ForkedProcess`."""

    @property
    def pid(self) -> int:
        """Its process id."""

    @property
    def stdin(self) -> IO[str] | None:
        """The end of its standard input to write to, if that is a pipe."""

    @property
    def stderr(self) -> IO[str] | None:
        """The end of its standard error to read from, if that is a pipe."""

    def poll(self) -> int | None:
        """Returns its exit code, minus the number of the signal that ended it; None while it runs."""

    def wait(self, timeout: float | None = None) -> int:
        """Waits for its end, `timeout` seconds at most, and returns its exit code.

        Raises:
            subprocess.TimeoutExpired: it still runs.
        """

    def terminate(self) -> None:
        """Sends it SIGTERM unless it has ended."""

    def kill(self) -> None:
        """Sends it SIGKILL unless it has ended."""


class InForkedChild(BaseException):
    """Unwinds the stack of a forked child up to `cli.main`, which begins again with the child's command line.

    Not an `Exception`, so that no handler of faults swallows it. Whoever forks holds nothing open that a `finally`
    would end: the child shares it with its parent.
    """


class ForkedProcess:
    """A child that was forked (a `Process`)."""

    def __init__(self, pid: int, stdin: IO[str], stderr: IO[str]) -> None:
        self.pid, self.stdin, self.stderr = pid, stdin, stderr
        self._exit_code: int | None = None

    def poll(self) -> int | None:
        """Returns its exit code, None while it runs."""
        if self._exit_code is None:
            ended, status = os.waitpid(self.pid, os.WNOHANG)
            if ended:
                self._exit_code = os.waitstatus_to_exitcode(status)
        return self._exit_code

    def wait(self, timeout: float | None = None) -> int:
        """Waits for its end, `timeout` seconds at most, and returns its exit code.

        Raises:
            subprocess.TimeoutExpired: it still runs.
        """
        end_s = None if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            if end_s is not None and time.monotonic() >= end_s:
                raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
            time.sleep(POLL_INTERVAL_S)
        return code

    def terminate(self) -> None:
        """Sends it SIGTERM unless it has ended."""
        self._send(signal.SIGTERM)

    def kill(self) -> None:
        """Sends it SIGKILL unless it has ended."""
        self._send(signal.SIGKILL)

    def close(self) -> None:
        """Closes this end of its pipes."""
        self.stdin.close()
        self.stderr.close()

    def _send(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)


def fork(
    arguments: Sequence[str], environment: Mapping[str, str], others: Sequence[ForkedProcess]
) -> ForkedProcess:
    """Forks a child that goes on as a command line with these `arguments`, and `environment` in addition to its own.

    Like the children that `child.open_process` starts it has a session of its own, ends with this process, and is
    told and says things by pipes. It closes its copies of the pipes of `others`, which were forked before it. Call it
    with one thread only.

    Raises:
        InForkedChild: in the child.
        OSError: no process or pipe can be had.
    """
    stdin, told = os.pipe()
    said, stderr = os.pipe()
    sys.stdout.flush()
    parent = os.getpid()
    pid = os.fork()
    if pid == 0:
        for each in others:
            each.close()
        _take_pipes(stdin, stderr, told, said)
        os.setsid()  # Ctrl-C reaches the supervisor only, which ends its children in order
        os.environ.update(environment, **{SUPERVISOR_VARIABLE: str(parent)})
        sys.argv[1:] = arguments
        raise InForkedChild
    os.close(stdin)
    os.close(stderr)
    return ForkedProcess(pid, os.fdopen(told, "w"), os.fdopen(said, errors="replace"))


def _take_pipes(stdin: int, stderr: int, *parents: int) -> None:
    """Makes two pipes the standard input and error of this process, and closes the others."""
    os.dup2(stdin, 0)
    os.dup2(stderr, 2)
    for each in (stdin, stderr, *parents):
        if each > 2:  # a process without standard streams gets pipes of these numbers
            os.close(each)
    sys.stdin = open(0, closefd=False)  # noqa: SIM115 - for the whole process; there may have been none
