"""Output folders of commands, and new recordings and folders that appear atomically and never replace anything."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import ACTIVE_SUFFIX

SUFFIX = ".mcap"


def make_output_folder(folder: Path) -> Path:
    """Creates `folder` if missing, and verifies that files can be written into it.

    Raises:
        DeltalightError: it is a file, or cannot be created or written.
    """
    if folder.exists() and not folder.is_dir():
        raise DeltalightError(f"The output folder '{folder}' is a file; name a folder.")
    probe = folder / f".write-test-{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as fault:
        raise DeltalightError(
            f"The output folder '{folder}' cannot be written ({fault.strerror}); choose another."
        ) from fault
    return folder


def require_output_folder(folder: Path) -> None:
    """Checks a folder that is written after long work; one that was missing is missing afterwards, too.

    Raises:
        DeltalightError: it is a file, or cannot be created or written.
    """
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    make_output_folder(folder)
    with suppress(OSError):  # another process may have begun to use it
        for each in missing:
            each.rmdir()


def require_output_file(path: Path) -> None:
    """Checks a file that is written after long work, so that the work is not lost; creates its folder if missing.

    Raises:
        DeltalightError: it is a folder, or its folder cannot be written.
    """
    if path.is_dir():
        raise DeltalightError(f"The output '{path}' is a folder; name a file in it.")
    make_output_folder(path.parent)


def require_new_recording(path: Path) -> None:
    """Checks the name of a recording to be written; creates its folder if missing.

    Raises:
        DeltalightError: the name is taken or not `*.mcap`, or the folder cannot be written.
    """
    require_absent(path.with_name(path.name + ACTIVE_SUFFIX))
    require_recording_name(path)


def require_recording_name(path: Path) -> None:
    """Checks the name of a recording to appear; creates its folder if missing.

    Raises:
        DeltalightError: the name is taken or not `*.mcap`, or the folder cannot be written.
    """
    if path.suffix != SUFFIX:
        raise DeltalightError(f"{path} must end in {SUFFIX}; choose another name.")
    require_absent(path)
    make_output_folder(path.parent)


def require_absent(path: Path) -> None:
    """Refuses to replace anything.

    Raises:
        DeltalightError: the path exists.
    """
    if path.exists() or path.is_symlink():
        raise DeltalightError(f"{path} already exists; choose another name or remove it.")


@contextmanager
def appearing(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path` for a file or folder.

    Moves it into place at the end, or removes it on an error. A killed process leaves it, hidden. The suffix stays.

    Raises:
        DeltalightError: `path` already exists, or the disk refuses.
    """
    require_absent(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        require_absent(path)
        temporary.rename(path)
    except OSError as fault:
        if isinstance(fault, FileNotFoundError) and not path.parent.is_dir():
            raise DeltalightError(
                f"the folder {path.parent} does not exist; create it or choose another name."
            ) from fault
        raise DeltalightError(
            f"{path} cannot be written ({fault.strerror}); free some space or choose another name."
        ) from fault
    finally:
        _remove(temporary)
        _remove(temporary.with_name(temporary.name + ACTIVE_SUFFIX))


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)
