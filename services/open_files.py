"""How many files and connections this process may have open."""

import resource

MOST_OPEN_FILES = 1 << 16  # some 2 GB of connections that have said nothing yet


def allow_many_connections() -> None:
    """Raise the limit of open files to the host's own, 65536 at most.

    The usual 1024 are taken by a stranger's connections in a moment, and then no process can be started.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST_OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, MOST_OPEN_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
