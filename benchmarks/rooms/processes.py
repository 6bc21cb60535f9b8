"""Processes of an installation: whether they are gone, idle, or listen at a port; and waiting for what comes."""

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import httpx
import psutil

from deltalight.protocol.errors import DeltalightError

PATIENCE_S = 150.0
POLL_S = 0.05  # each look is a request, whose answer takes what it waits for from the processor
SHORT_S = 0.3  # of rest: a process that waits for nobody has none
SERVER_COMMAND = "server"


def wait_for(condition: Callable[[], bool], what: str = "What was waited for") -> None:
    """Waits until a condition holds; requests that are not answered meanwhile are made again.

    Raises:
        DeltalightError: it does not within `PATIENCE_S`.
    """
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        with suppress(httpx.TransportError):
            if condition():
                return
        time.sleep(POLL_S)
    raise DeltalightError(
        f"{what} did not come within {PATIENCE_S:.0f} s; run it again on a quieter machine."
    )


def is_gone(process: psutil.Process) -> bool:
    """Whether a process has ended, whoever has still to be told."""
    with suppress(psutil.NoSuchProcess):
        return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE
    return True


def wait_until_idle(process: psutil.Process, quiet_s: float = SHORT_S) -> None:
    """Waits until a process has done what it had to do: all its threads sleep, and it takes no processor time.

    Raises:
        DeltalightError: it never rests for `quiet_s`.
    """
    tasks = Path(f"/proc/{process.pid}/task")
    used_s = [-1.0]

    def is_idle() -> bool:
        time.sleep(quiet_s)
        used_s.append(sum(process.cpu_times()[:2]))
        states = {_state_of(thread) for thread in tasks.iterdir()}
        return used_s[-1] == used_s[-2] and states <= {"S", ""}

    wait_for(is_idle, "Rest of a process")


def is_render_server(process: psutil.Process) -> bool:
    """Whether a process is a render server, or a spare that waits to become one."""
    with suppress(psutil.Error):
        return SERVER_COMMAND in process.cmdline()
    return False


def listens_at(process: psutil.Process, port: int) -> bool:
    """Whether a process accepts connections at a TCP port."""
    with suppress(psutil.Error):
        return any(
            each.laddr.port == port and each.status == psutil.CONN_LISTEN
            for each in process.net_connections("tcp")
        )
    return False


def children_of(process: psutil.Process) -> list[psutil.Process]:
    """Returns all processes below one; none of one that is gone."""
    with suppress(psutil.NoSuchProcess):
        return list(process.children(recursive=True))
    return []


def _state_of(thread: Path) -> str:
    """The letter of a thread's state in /proc; "" where it has ended."""
    with suppress(OSError):
        return (thread / "stat").read_text().rpartition(") ")[2][0]
    return ""
