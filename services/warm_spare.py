"""Spare processes that have prepared what a command needs and wait to take the place of one that died."""

import os
import pkgutil
import sys

SPARE_VARIABLE = "DELTALIGHT_SPARE_PREPARES"
GO = b"1"


def spare_environment(prepared: tuple[str, ...]) -> dict[str, str]:
    """Return the variable that makes a started command wait as a spare once it has prepared these.

    `module` is imported, `module:function` called.
    """
    return {SPARE_VARIABLE: ",".join(prepared)}


def wait_if_spare() -> None:
    """Where this process was started as a spare: prepare, wait for GO on stdin, and have an empty stdin from then on.

    Ends the process if stdin ends without GO: its supervisor is gone, or has no use for it.
    """
    prepared = os.environ.pop(SPARE_VARIABLE, None)
    if prepared is None:
        return
    for name in filter(None, prepared.split(",")):
        found = pkgutil.resolve_name(name)
        if callable(found):
            found()
    if os.read(sys.stdin.fileno(), 1) != GO:
        sys.exit(0)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, sys.stdin.fileno())
    os.close(nothing)
