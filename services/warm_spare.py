"""Spare processes that have prepared what a command needs and wait to take the place of one that died."""

import json
import os
import pkgutil
import select
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from deltalight.services.garbage_collection import no_garbage_collection
from deltalight.services.process import Process

SPARE_VARIABLE = "DELTALIGHT_SPARE_PREPARES"
GO, REHEARSE = "1", "2"  # what spares are told, a line each, arguments following; GO is the last one
PREPARED = {  # by spares of a command
    "node": ("deltalight.services.node_process", "pydantic_settings", "blosc2"),
    "replay": ("deltalight.services.node_process", "pydantic_settings", "blosc2"),
    "server": ("deltalight.render_server.server.process:warm_up", "pydantic_settings", "blosc2"),
    "api": ("deltalight.services.api.serve", "pydantic_settings"),
}
SHARED = (  # what all of them import: whoever forks them imports it once
    "deltalight.protocol.codecs",
    "deltalight.services.host",
    "deltalight.services.watchdog",
    "pydantic_settings",
    "blosc2",
)
ENDED_BY_SIGNAL = 128  # and the signal's number is the exit code


class Spare:
    """This process as a spare: what it is told on stdin.

    `is_rehearsing`: the command that runs shall only get ready, `is_called` tells until when. What it keeps in
    `prepared` is for the command that the process becomes.
    """

    def __init__(self, stdin: int) -> None:
        self.is_rehearsing = False
        self.prepared: Any = None
        self._stdin = stdin
        self._unread = b""
        self._has_ended = False

    def is_called(self, timeout_s: float = 0.0) -> bool:
        """Waits so long to be told something; returns whether there is anything, or stdin has ended."""
        while not (b"\n" in self._unread or self._has_ended):
            if not select.select([self._stdin], [], [], timeout_s)[0]:
                return False
            self._read()
        return True

    def next_line(self) -> str:
        """Waits for the next line and returns it; empty once stdin has ended."""
        while not (b"\n" in self._unread or self._has_ended):
            self._read()
        line, _, self._unread = self._unread.partition(b"\n")
        return line.decode()

    def rehearse(self, arguments: Sequence[str], run: Callable[[list[str]], int]) -> None:
        """Runs a command until it is ready; a signal ends the process, a fault leaves the spare as it was."""
        self.is_rehearsing = True
        code = run(list(arguments))
        self.is_rehearsing = False
        if code > ENDED_BY_SIGNAL:
            sys.exit(code)

    def _read(self) -> None:
        piece = os.read(self._stdin, 65536)
        self._unread += piece
        self._has_ended = not piece


_spare: Spare | None = None


def this_spare() -> Spare | None:
    """Returns what this process is or was as a spare; None if it was started as what it is."""
    return _spare


def spare_environment(prepared: tuple[str, ...]) -> dict[str, str]:
    """Returns the variable that makes a started command wait as a spare once it has prepared these.

    `module` is imported, `module:function` called.
    """
    return {SPARE_VARIABLE: ",".join(prepared)}


def rehearse_spare(spare: Process, arguments: Sequence[str]) -> None:
    """Tells a spare to get ready for a command with these arguments, once it has prepared what it was started for."""
    assert spare.stdin is not None
    with suppress(OSError):  # it died meanwhile
        spare.stdin.write(REHEARSE + json.dumps(arguments) + "\n")
        spare.stdin.flush()


def use_spare(spare: Process, arguments: Sequence[str] = ()) -> bool:
    """Tells a spare to go on, with other `arguments` than its own if there are any; returns whether it does."""
    assert spare.stdin is not None
    if spare.poll() is not None:
        return False
    try:
        with spare.stdin as told:
            told.write(GO + (json.dumps(arguments) if arguments else ""))
    except OSError:  # it died meanwhile
        spare.kill()
        spare.wait()
        return False
    return True


def wait_if_spare(run: Callable[[list[str]], int]) -> None:
    """Where this process was started as a spare: prepare, wait for GO on stdin, and have an empty stdin from then on.

    Arguments that follow GO replace those of the command line; `run` runs a command that is to be rehearsed before.
    Ends the process if stdin ends without GO: its supervisor is gone, or has no use for it.
    """
    global _spare  # noqa: PLW0603 (of the process)
    prepared = os.environ.pop(SPARE_VARIABLE, None)
    if prepared is None:
        return
    prepare([name for name in prepared.split(",") if name])
    _spare = Spare(sys.stdin.fileno())
    while (told := _spare.next_line()).startswith(REHEARSE):
        _spare.rehearse(json.loads(told[len(REHEARSE) :]), run)
    if not told.startswith(GO):
        sys.exit(0)
    if len(told) > len(GO):
        sys.argv[1:] = json.loads(told[len(GO) :])
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, sys.stdin.fileno())
    os.close(nothing)


def prepare(names: Sequence[str]) -> None:
    """Prepares these (`spare_environment`) in this process."""
    with no_garbage_collection():
        for name in names:
            found = pkgutil.resolve_name(name)
            if callable(found):
                found()
