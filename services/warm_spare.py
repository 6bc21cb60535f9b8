"""Spare processes that have prepared what a command needs and wait to take the place of one that died."""

import json
import os
import pkgutil
import subprocess
import sys
from collections.abc import Sequence

from deltalight.services.uncollected import uncollected

SPARE_VARIABLE = "DELTALIGHT_SPARE_PREPARES"
GO = b"1"
PREPARED = {  # by spares of a command
    "node": ("deltalight.services.node_process", "pydantic_settings", "blosc2"),
    "replay": ("deltalight.services.node_process", "pydantic_settings", "blosc2"),
    "server": ("deltalight.render_server.server.process:warm_up", "pydantic_settings", "blosc2"),
    "api": ("deltalight.services.api.serve", "pydantic_settings"),
}


def spare_environment(prepared: tuple[str, ...]) -> dict[str, str]:
    """Return the variable that makes a started command wait as a spare once it has prepared these.

    `module` is imported, `module:function` called.
    """
    return {SPARE_VARIABLE: ",".join(prepared)}


def use_spare(spare: "subprocess.Popen[str]", arguments: Sequence[str] = ()) -> bool:
    """Tell a spare to go on, with other `arguments` than its own if there are any; return whether it does."""
    assert spare.stdin is not None
    if spare.poll() is not None:
        return False
    try:
        with spare.stdin as told:
            told.write(GO.decode() + (json.dumps(arguments) if arguments else ""))
    except OSError:  # it died meanwhile
        spare.kill()
        spare.wait()
        return False
    return True


def wait_if_spare() -> None:
    """Where this process was started as a spare: prepare, wait for GO on stdin, and have an empty stdin from then on.

    Arguments that follow GO replace those of the command line. Ends the process if stdin ends without GO: its
    supervisor is gone, or has no use for it.
    """
    prepared = os.environ.pop(SPARE_VARIABLE, None)
    if prepared is None:
        return
    with uncollected():
        _prepare([name for name in prepared.split(",") if name])
    told = _read_all(sys.stdin.fileno())
    if not told.startswith(GO):
        sys.exit(0)
    if len(told) > len(GO):
        sys.argv[1:] = json.loads(told[len(GO) :])
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, sys.stdin.fileno())
    os.close(nothing)


def _prepare(names: Sequence[str]) -> None:
    for name in names:
        found = pkgutil.resolve_name(name)
        if callable(found):
            found()


def _read_all(stdin: int) -> bytes:
    pieces = iter(lambda: os.read(stdin, 65536), b"")
    return b"".join(pieces)
