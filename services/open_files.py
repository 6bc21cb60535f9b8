"""What files and connections this process may have open."""

import os
import resource
import sys
from pathlib import Path

MOST_OPEN_FILES = 1 << 16  # some 2 GB of connections that have said nothing yet


def allow_many_connections() -> None:
    """Raises the limit of open files to the host's own, 65536 at most.

    The usual 1024 are taken by a stranger's connections in a moment, and then no process can be started.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST_OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, MOST_OPEN_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def open_standard_streams() -> None:
    """Opens those that were closed (`2>&-`) on nothing: the next file would have their number, and get their text."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode))  # noqa: SIM115 - for as long as the process runs
