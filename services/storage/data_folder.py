"""The data folder as a whole: who uses it, and how other contents take its place.

Any number of processes use it together, one that replaces its contents uses it alone (flock(2); the lock of a killed
process is free).
"""

import fcntl
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path

from deltalight.protocol.errors import DeltalightError

DATABASE, ASSETS = "store.sqlite3", "assets"
_STAGED, _ASIDE = ".restoring-", "before-restore-"
# The log of the database goes first: it must never meet another database.
_CONTENTS = (f"{DATABASE}-wal", f"{DATABASE}-shm", ASSETS, DATABASE)


def use_folder(folder: Path) -> ExitStack:
    """Uses a data folder together with others, until what is returned is closed; finishes a restore that was cut off.

    Raises:
        DeltalightError: its contents are being replaced now, or it cannot be written.
    """
    if any(folder.glob(f"{_STAGED}*")):
        with use_folder_alone(folder):
            finish_replacing(folder)
    return _locked(folder, fcntl.LOCK_SH, "is being restored now; wait for the end of that.")


def use_folder_alone(folder: Path) -> ExitStack:
    """Uses a data folder alone, until what is returned is closed.

    Raises:
        DeltalightError: a process uses it, or it cannot be written.
    """
    return _locked(
        folder,
        fcntl.LOCK_EX,
        "is in use; stop the service (and `deltalight backup`) that uses it, then try again.",
    )


@contextmanager
def doing_jobs(folder: Path) -> Iterator[bool]:
    """Announces during the block that this process records and replays; yields whether another one does so, too.

    It does so by a lock of this process alone (lockf(3)): what it forks does not keep it.
    """
    with (folder / ".jobs").open("a+") as mark:
        try:
            fcntl.lockf(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
            is_shared = False
        except (BlockingIOError, PermissionError):
            is_shared = True
        fcntl.lockf(mark, fcntl.LOCK_SH)
        yield is_shared


def staging_folder(folder: Path) -> Path:
    """Returns the name of a folder that takes the contents' place as soon as it exists."""
    return folder / f"{_STAGED}{datetime.now(UTC):%Y%m%dT%H%M%S%f}"


def finish_replacing(folder: Path) -> Path | None:
    """Moves staged contents into place, and those of before aside; returns where they are then.

    May be cut off at any point, and called again: what was moved stays, the rest follows.
    """
    aside = None
    for staged in sorted(folder.glob(f"{_STAGED}*")):
        aside = folder / (_ASIDE + staged.name.removeprefix(_STAGED))
        for name in _CONTENTS:
            _replace(staged, folder, aside, name)
        sync_folder(folder)
        staged.rmdir()
    return aside if aside is not None and aside.is_dir() else None


def sync_folder(folder: Path) -> None:
    """Makes the names in a folder durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _replace(staged: Path, folder: Path, aside: Path, name: str) -> None:
    is_moved = not (staged / DATABASE).exists()  # it is the last: all others were moved before
    if is_moved or (name in (ASSETS, DATABASE) and not (staged / name).exists()):
        return
    if (folder / name).exists():
        aside.mkdir(mode=0o700, exist_ok=True)
        (folder / name).rename(aside / name)
        sync_folder(aside)
    if (staged / name).exists():
        (staged / name).rename(folder / name)
        sync_folder(folder)


def _locked(folder: Path, kind: int, refusal: str) -> ExitStack:
    held = ExitStack()
    try:
        lock = held.enter_context((folder / ".lock").open("a"))
        fcntl.flock(lock, kind | fcntl.LOCK_NB)
    except BlockingIOError as fault:
        held.close()
        raise DeltalightError(f"{folder} {refusal}") from fault
    except OSError as fault:
        held.close()
        raise DeltalightError(
            f"{folder} cannot be written ({fault.strerror}); name another folder with --data."
        ) from fault
    return held
